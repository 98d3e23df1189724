"""HDF5 loads no code that a file asks for."""

import subprocess
import sys

import h5py
import numpy as np
import pytest

from tests.command import environment

UNKNOWN = 32_123
"""Number of a filter that nobody has."""

REFUSED = "filter plugins disabled"

READ = """
import sys
import h5py
try:
    h5py.File(sys.argv[1])["x"][()]
except OSError as error:
    print(error)
"""


def asking(folder):
    """A file whose data went through a filter that only a plug-in could undo; and variables of an
    environment that name a folder with a library that is none."""
    path = folder / "asks.h5"
    with h5py.File(path, "w") as file:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((10,))
        plan.set_filter(UNKNOWN, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((10,))
        dataset = h5py.h5d.create(file.id, b"x", h5py.h5t.NATIVE_INT32, space, plan)
        dataset.write_direct_chunk((0,), np.arange(10, dtype="i4").tobytes())
    (folder / "plug-ins").mkdir()
    (folder / "plug-ins" / "libno.so").write_text("no library")
    new = environment(HDF5_PLUGIN_PATH=str(folder / "plug-ins"))
    new.pop("HDF5_PLUGIN_PRELOAD", None)
    return path, new


@pytest.mark.parametrize("module", ["numpy", "models.hdf5"])
def test_no_plug_in_is_looked_for(module, tmp_path):
    """Without :mod:`models.hdf5`, NumPy's line, HDF5 would try each library in the folder.

    That nothing does beside TensorFlow either is in tests/test_old_worlds.py.
    """
    path, new = asking(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", f"from {module} import *\n{READ}", str(path)],
        env=new,
        capture_output=True,
        text=True,
        timeout=300,
    )
    if module == "numpy":
        assert "libno.so" in done.stdout, done
    else:
        assert REFUSED in done.stdout, done
