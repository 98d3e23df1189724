"""The public names: ``from stmnist import Recordings, Run, Stream, ...``; see docs/python.md.

Each name is loaded from its module on first use, after the plugins (:mod:`deploy.plugins`).  The
import therefore takes almost no time, and TensorFlow is imported only by code that trains.

This distribution's own packages have common names: ``deploy``, ``models`` and ``pipeline``.  A file
``models.py`` next to a notebook or script would be found before ours, and our modules that import
``models`` would fail.  Therefore this module first binds the three names to the packages next to
this one, independently of Python's search path, in this process and in its workers.  For a user's
own file with such a name this has these consequences:

- Imported after ``stmnist``, ``import models`` returns our package, not the file, because a name
  has one module in a process.  Rename the file, or load it by its path under another name
  (``importlib.util.spec_from_file_location("mine", "models.py")``).
- Imported before ``stmnist``, it does not change, and ``import stmnist`` raises an `ImportError`
  that names the file.  A script that is called ``models.py`` causes no problem: it is ``__main__``.
"""

import importlib
import importlib.util
import os
import sys

# Packages of this distribution, in addition to this one.
PACKAGES = ("deploy", "models", "pipeline")

# Public names in three groups, in the order of use, each with the module that has it.
GROUPS = {
    "Recordings and runs": {
        "Recordings": "pipeline.recordings.recordings",
        "write_recordings": "pipeline.recordings.files.writing",
        "draw_recording": "pipeline.results.report.figures.recordings",
        "Run": "pipeline.api.run",
        "Settings": "pipeline.settings",
        "compare_runs": "pipeline.api.run",
        "UserError": "deploy.errors",
    },
    "Deployed networks": {
        "Stream": "deploy.stream.stream",
        "Decision": "deploy.stream.touch",
        "read_bundle": "deploy.check.bundle",
        "run_check": "deploy.check.run",
        "compare_results": "deploy.check.comparison",
        "make_plan": "deploy.preflight.plan",
        "estimate_energy": "deploy.check.energy",
        "write_nir": "deploy.network.nir",
    },
    "Any network": {
        "read_nir": "models.nir.graph",
        "simulate": "models.nir.simulator",
        "FastSimulator": "fastloihi",
        "accelerate": "fastloihi",
    },
}

_MODULE_OF = {name: module for group in GROUPS.values() for name, module in group.items()}

# Modules to import before others: NengoLoihi is imported without TensorFlow.
_BEFORE = {"fastloihi": "deploy.network.loihi_import"}

__all__ = sorted(_MODULE_OF)


def bind():
    """Bind the names of `PACKAGES` to the folders next to this one; done on import.

    A second call changes nothing.

    Raises
    ------
    ImportError
        Another module was imported under one of the names; in this case nothing is bound.
    """
    here = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    files = {name: os.path.join(here, name, "__init__.py") for name in PACKAGES}
    for name, file in files.items():
        if name in sys.modules and not _is(sys.modules[name], file):
            raise ImportError(
                f"{_locate(sys.modules[name])} was imported as {name!r} before stmnist, which has "
                f"a package of that name; import stmnist first, or rename your {name!r}",
                name=name,
            )
    for name, file in files.items():
        if name not in sys.modules:
            spec = importlib.util.spec_from_file_location(
                name, file, submodule_search_locations=[os.path.dirname(file)]
            )
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module
            spec.loader.exec_module(module)


def prepare_worker():
    """Prepare a process that works for this one, before it imports anything else."""
    bind()
    importlib.import_module("deploy.plugins").load_plugins(is_worker=True)


def _is(module, file):
    path = getattr(module, "__file__", None)
    return path is not None and os.path.realpath(path) == os.path.realpath(file)


def _locate(module):
    """The file of a module, or the folder of a package without ``__init__.py``."""
    return getattr(module, "__file__", None) or next(
        iter(getattr(module, "__path__", ())), "a module"
    )


def __getattr__(name):
    if name == "__version__":
        return importlib.import_module("deploy").__version__
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    importlib.import_module("deploy.plugins").load_plugins()
    module = _MODULE_OF[name]
    if module in _BEFORE:
        importlib.import_module(_BEFORE[module])
    value = getattr(importlib.import_module(module), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted({*globals(), *__all__})


bind()
