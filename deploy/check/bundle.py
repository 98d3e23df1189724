"""The bundle: a folder with everything that a host needs to run the network and its check.

========================  ==================================================================
``network.json``          schema, layers, neurons, time step, presentation, placement
``weights.npz``           weights and biases of each layer
``checks.npz``            inputs, labels and sample ids of the check, and its seed
``deploy.pyz``            this package and fastloihi as a zipapp
``MANIFEST.json``         SHA-256 of each file; its own SHA-256 is the bundle's id
``checks/``               not part of the bundle: the folder for results of ``deploy.pyz``
========================  ==================================================================

Nothing in a bundle is executed on reading, and a file that does not match its hash is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from .. import limits
from ..errors import UserError
from ..files import (
    TEMPORARY,
    WRITE_REMEDY,
    hash_file,
    read_arrays,
    read_json,
    refuse_linked_folder,
    replacing,
    reporting_os_errors,
    write_arrays,
    write_json,
    zip_member,
)
from ..network.spec import NetworkSpec
from ..network.stimulus import Stimulus
from ..terminal import format_command

NETWORK_SCHEMA = "stmnist-bundle/3"
MANIFEST_SCHEMA = "stmnist-manifest/1"
FILES = ("network.json", "weights.npz", "checks.npz", "deploy.pyz")
RESULTS = "checks"
# The file of settings next to the bundle of a run.
RUN_SETTINGS = "experiment.toml"
# More bytes than the headers of the arrays of ``checks.npz``.
MAX_HEADER_BYTES = 1 << 12
_REMEDY = "delete the folder and make it again with 'stmnist convert', or copy it again"


@dataclass(frozen=True)
class CheckSet:
    """The samples of a check, which are the same for every target.

    Attributes
    ----------
    inputs : ndarray, shape (n_samples, ...)
        Normalised tactile images or event frames, in the format of the network's stimulus.
    labels : ndarray of int, shape (n_samples,)
    ids : tuple of str
    seed : int
        Seed with which they were drawn from the test set.
    """

    inputs: np.ndarray
    labels: np.ndarray
    ids: tuple
    seed: int

    def __len__(self):
        return len(self.labels)

    def __repr__(self):
        return f"CheckSet({len(self)} samples of shape {self.inputs.shape[1:]})"

    @property
    def sha256(self):
        """SHA-256 of inputs, labels and ids."""
        inputs = np.ascontiguousarray(self.inputs)
        labels = np.asarray(self.labels, np.int64)
        described = json.dumps([str(inputs.dtype), inputs.shape, labels.tolist(), self.ids])
        digest = hashlib.sha256(described.encode())
        digest.update(inputs)
        return digest.hexdigest()

    def __getitem__(self, samples: slice) -> CheckSet:
        """A subset of the samples."""
        return CheckSet(self.inputs[samples], self.labels[samples], self.ids[samples], self.seed)


@dataclass(frozen=True)
class Bundle:
    """A bundle that has been read and verified.

    Attributes
    ----------
    path : Path
    id : str
        SHA-256 of ``MANIFEST.json``.
    spec : NetworkSpec
    checks : CheckSet
    """

    path: Path
    id: str
    spec: NetworkSpec
    checks: CheckSet

    def __repr__(self):
        return (
            f"Bundle({str(self.path)!r}: {self.id[:12]}, {self.spec.architecture}, "
            f"{len(self.checks)} samples)"
        )

    @property
    def seed(self):
        """Seed of the run that made the bundle, not validated; its targets run with it."""
        return self.spec.provenance.seed


def write_bundle(path, spec: NetworkSpec, checks: CheckSet) -> Bundle:
    """Write a bundle, replacing an existing one but for its results, and read it back.

    The folder is filled under a temporary name and then renamed, so that after an interruption the
    previous bundle or the complete new one exists.

    Parameters
    ----------
    path : path-like
    spec : NetworkSpec
    checks : CheckSet
        With inputs in the format of the network's stimulus.

    Raises
    ------
    UserError
        The path is that of a file, or of a folder with files of other kinds, which would be lost;
        the samples are too large for a bundle; or the folder cannot be written.
    ValueError
        The samples of the check do not fit the network, or each other.
    """
    path = Path(os.path.realpath(str(path)))  # a link that the user names is followed
    samples = {
        "inputs": np.asarray(checks.inputs, _choose_dtype(spec.stimulus)),
        "labels": np.asarray(checks.labels, np.int64),
        "ids": np.array(checks.ids, dtype=str),
        "seed": np.array(checks.seed, np.int64),
    }
    for name in ("inputs", "labels"):
        is_changed = not np.array_equal(samples[name], getattr(checks, name))
        if samples[name].dtype.kind != "f" and is_changed:
            raise ValueError("a label or an event is not a whole number, or out of range")
    _require_room(sum(array.nbytes for array in samples.values()), len(checks), spec.stimulus)
    if (wrong := _find_problem(samples, spec)) is not None:
        raise ValueError(f"the samples of the check do not fit the network: {wrong}")
    with reporting_os_errors(path, "cannot write", WRITE_REMEDY):
        require_replaceable(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(TEMPORARY, ".bundle.", str(path.parent)) as temporary:
            folder_of_new = Path(temporary) / "new"
            folder_of_new.mkdir()
            write_json(folder_of_new / "network.json", {"schema": NETWORK_SCHEMA, **spec.to_json()})
            write_arrays(folder_of_new / "weights.npz", **spec.to_arrays())
            write_arrays(folder_of_new / "checks.npz", **samples)
            with replacing(folder_of_new / "deploy.pyz") as file:
                file.write(make_zipapp())
            hashes = {name: hash_file(folder_of_new / name) for name in FILES}
            write_json(
                folder_of_new / "MANIFEST.json", {"schema": MANIFEST_SCHEMA, "files": hashes}
            )
            read_bundle(folder_of_new)
            _exchange(folder_of_new, path, Path(temporary) / "old")
    return read_bundle(path)


def require_replaceable(path):
    """Refuse a path where a bundle would replace a file, or a folder with files of other kinds.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    UserError
    """
    path = Path(path)
    if not path.exists():
        return
    if not path.is_dir():
        raise UserError(f"{path}: is a file, not a bundle's folder; move it away")
    others = {entry.name for entry in path.iterdir()} - {*FILES, "MANIFEST.json", RESULTS}
    if others:
        raise UserError(
            f"{path}: not replaced by a bundle, because it also has {min(others)}; move that away"
        )


def require_room(n_samples: int, shape: tuple, stimulus: Stimulus):
    """Refuse a check whose inputs are too large for a bundle, before the inputs exist.

    Parameters
    ----------
    n_samples : int
        Number of samples.
    shape : tuple of int
        Shape of one sample.
    stimulus : Stimulus

    Raises
    ------
    UserError
    """
    _require_room(
        math.prod((n_samples, *shape, _choose_dtype(stimulus).itemsize)), n_samples, stimulus
    )


def _require_room(n_bytes, samples, stimulus):
    if n_bytes > limits.ARRAY_BYTES - MAX_HEADER_BYTES:
        remedy = "fewer check.samples"
        if not stimulus.is_static:
            remedy += " or presentation.steps, or a larger data.downsample"
        raise UserError(
            f"the check's {samples} samples take {n_bytes / 2**20:.0f} MB, more than the "
            f"{limits.ARRAY_BYTES >> 20} MB of a bundle; choose {remedy}"
        )


def _choose_dtype(stimulus):
    return np.dtype(np.float32 if stimulus.is_static else np.uint8)


def find_result_path(folder, target: str) -> Path:
    """The default file of a result of ``deploy.pyz``, in ``checks`` of the bundle's folder.

    Parameters
    ----------
    folder : Path
        The bundle's, which may have been copied without its run.
    target : str

    Raises
    ------
    UserError
        ``checks`` is a symbolic link: the result would be written elsewhere.
    """
    results = Path(folder) / RESULTS
    refuse_linked_folder(results)
    return results / f"{target}.json"


def _exchange(new, path, old):
    """Put a new bundle in place of another one, which becomes ``old``, and keep its results."""
    try:
        if path.exists():
            os.replace(str(path), str(old))
        os.replace(str(new), str(path))
    finally:
        if not path.exists() and old.exists():
            os.replace(str(old), str(path))
        elif (old / RESULTS).exists():
            os.replace(str(old / RESULTS), str(path / RESULTS))


def read_bundle(path) -> Bundle:
    """Read and verify a bundle.

    Raises
    ------
    UserError
        The folder is not a bundle; a file is missing or changed; the version of the schema
        or the time step is not supported; an array does not fit the description.
    """
    path = Path(path)
    if not (path / "MANIFEST.json").exists():
        if (path.parent / RUN_SETTINGS).exists() and not path.exists():
            remedy = format_command("convert", path.parent)
            raise UserError(f"{path.parent}: has no bundle yet; make it with {remedy}")
        if not path.exists():
            raise UserError(
                f"{path}: does not exist; give the folder of a run or of a bundle, as 'stmnist "
                "convert' makes"
            )
        raise UserError(f"{path}: not a bundle; give the folder of one, as 'stmnist convert' makes")
    manifest = read_json(path / "MANIFEST.json", _REMEDY)
    _require_schema(path / "MANIFEST.json", manifest.get("schema"), MANIFEST_SCHEMA)
    hashes = manifest.get("files")
    if not isinstance(hashes, dict) or sorted(hashes) != sorted(FILES):
        raise UserError(f"{path / 'MANIFEST.json'}: does not list the files of a bundle; {_REMEDY}")
    for name in FILES:
        if not (path / name).is_file():
            raise UserError(f"{path / name}: missing from the bundle; {_REMEDY}")
        if hash_file(path / name) != hashes[name]:
            raise UserError(f"{path / name}: changed since the bundle was made; {_REMEDY}")
    description = read_json(path / "network.json", _REMEDY)
    _require_schema(path / "network.json", description.get("schema"), NETWORK_SCHEMA)
    try:
        spec = NetworkSpec.from_json(description, read_arrays(path / "weights.npz", _REMEDY))
        checks = _read_checks(path / "checks.npz", spec)
    except UserError as error:
        message = str(error)
        raise UserError(message if str(path) in message else f"{path}: {message}") from error
    return Bundle(path, hash_file(path / "MANIFEST.json"), spec, checks)


def _read_checks(path, spec):
    arrays = read_arrays(path, _REMEDY)
    if (wrong := _find_problem(arrays, spec)) is not None:
        raise UserError(f"{path}: does not fit the network: {wrong}; {_REMEDY}")
    inputs = arrays["inputs"]
    return CheckSet(
        inputs=inputs.astype(float) if spec.stimulus.is_static else inputs,
        labels=arrays["labels"],
        ids=tuple(arrays["ids"].tolist()),
        seed=int(arrays["seed"]),
    )


def _find_problem(arrays, spec):
    """The reason why arrays cannot be the samples of a network's check, or None."""
    if sorted(arrays) != ["ids", "inputs", "labels", "seed"]:
        names = ", ".join(sorted(arrays)[:10])
        return f"its arrays are {names}, not ids, inputs, labels and seed"
    inputs, labels, ids, seed = (arrays[name] for name in ("inputs", "labels", "ids", "seed"))
    kinds = (array.dtype.kind for array in (labels, ids, seed))
    if not all(kind in known for kind, known in zip(kinds, ("iu", "U", "iu"))):
        return "labels and seed are not whole numbers, or ids not text"
    if (labels.ndim, ids.ndim, seed.ndim) != (1, 1, 0) or inputs.ndim < 1:
        return "inputs, labels, ids or seed have a wrong number of dimensions"
    if not limits.SAMPLES >= len(inputs) == len(labels) == len(ids) >= 1:
        return "inputs, labels and ids differ in length, or there are none or too many"
    classes = spec.layers[-1].size
    if labels.min() < 0 or labels.max() >= classes:
        return f"labels are not from 0 to {classes - 1}"
    try:
        if len({name.encode("utf-8") for name in ids.tolist()}) != len(ids):
            return "two samples have the same id"
    except UnicodeEncodeError:
        return "an id is not text in UTF-8"
    return spec.stimulus.find_problem(inputs, spec.input_shape, spec.presentation.steps)


def _require_schema(path, schema, known):
    if schema != known:
        raise UserError(
            f"{path}: schema {schema!r}, but this version reads {known!r}; "
            "use the version of this package that made the bundle, or make the bundle again"
        )


def make_zipapp() -> bytes:
    """This package and fastloihi as a zipapp; the bytes are the same for the same source files."""
    main = 'import runpy\n\nrunpy.run_module("deploy", run_name="__main__")\n'
    members = {"__main__.py": main.encode()}
    # It is found and not imported, because `network.loihi_import` imports it without TensorFlow.
    emulator = find_spec("fastloihi")
    assert emulator is not None  # this package depends on it
    assert emulator.origin is not None  # it has an __init__.py
    init_files = Path(__file__).parent.parent / "__init__.py", Path(emulator.origin)
    for package in (file.resolve().parent for file in init_files):
        for source in sorted(package.rglob("*.py")):
            members[source.relative_to(package.parent).as_posix()] = source.read_bytes()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(zip_member(name), content)
    return buffer.getvalue()
