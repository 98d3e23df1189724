"""Read NIR files as data: groups, numbers and texts of an HDF5 file, as plain nested values.

NIR (Neuromorphic Intermediate Representation; Pedersen et al., Nature Communications 15, 8122,
2024) is written by the package ``nir`` as HDF5: a group ``node`` that describes the graph, with one
group for each node below ``nodes``, and the pairs of names ``edges``.  :mod:`models.nir_graph`
interprets the nodes.

Nothing in a file is executed, and the package ``nir`` is not needed: only groups, numbers and texts
in the file itself are read.  Links to other files, virtual and external storage, and filters other
than HDF5's usual ones, which would be plug-ins, are refused.  The file is opened in a separate
process (:mod:`models.apart`); this module, run as a script, is that process.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from models.apart import MAX_SECONDS, Crashed, TooSlow, answer_apart, content_of, read_apart
from models.hdf5 import h5py, unusual_filters

MAX_FILE = 256 * 2**20
"""Bytes of a file."""

MAX_NUMBERS = 30_000_000
"""Numbers that are read from a file."""

MAX_OBJECTS = 20_000
"""Groups and datasets of a file."""

MAX_DEPTH = 12
"""Groups within groups."""

MAX_TEXT = 2**20
"""Characters of a text."""

REMEDY = "write it with nir.write('network.nir', graph)"
_HDF5 = b"\x89HDF\r\n\x1a\n"


class NirError(UserError):
    """A file or graph is not NIR, or has parts that cannot be used; the message is one line."""


def shown(text) -> str:
    """Text from a file for a message: quoted, on one line, and shortened."""
    text = repr(str(text)[:60])
    return text if len(text) <= 80 else text[:77] + "...'"


def _where(parents, name) -> str:
    """A group or dataset as a message names it: a node, a node's value, or another place."""
    nodes = [part for part in parents[1:] if part != "nodes"]
    if parents[1:2] != ("nodes",):
        return shown("/".join((*parents, name)))
    if parents[-1] == "nodes":
        return f"node {shown('.'.join((*nodes, name)))}"
    return f"node {shown('.'.join(nodes))}: its {shown(name)}"


def read_nir_file(path) -> dict:
    """The graph in a NIR file as nested dicts.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    dict
        As ``nir.NIRGraph.to_dict()`` returns it: a ``type``, ``nodes`` by name, ``edges``, and
        further entries.  Numbers are arrays, texts are ``str``.

    Raises
    ------
    NirError
        The file is missing, not NIR, damaged or too large, or it has links to other files or
        plug-ins.
    """
    path = Path(path)
    try:
        content = content_of(path, MAX_FILE)
    except ValueError as error:
        raise NirError(str(error)) from error
    if len(content) > MAX_FILE:
        raise NirError(f"{path}: larger than the {MAX_FILE >> 20} MiB that can be read")
    try:
        answer, arrays = read_apart("models.nir_file", content)
    except TooSlow as error:
        raise NirError(
            f"{path}: could not be read in {MAX_SECONDS} s and may be damaged; {REMEDY}"
        ) from error
    except Crashed as error:
        raise NirError(f"{path}: damaged; {REMEDY}") from error
    if "problem" in answer:
        raise NirError(f"{path}: {answer['problem']}")
    return _filled(answer["tree"], arrays)


def read_content(content: bytes) -> tuple:
    """Read a file's content in this process, which a damaged file may crash.

    Returns
    -------
    tree : dict
        Groups as dicts; an array is replaced by ``["array", its name]``, a text by ``["text",
        text]``.
    arrays : dict of str to ndarray

    Raises
    ------
    NirError
        As :func:`read_nir_file`, except for errors of opening the file.
    """
    if not content.startswith(_HDF5):
        raise NirError(f"not a NIR file, which is HDF5; {REMEDY}")
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            if "node" not in file:
                raise NirError(f"HDF5, but not a NIR file: it has no group 'node'; {REMEDY}")
            reader = _Reader()
            tree = reader.group({"node": None}, file)["node"]
            if not isinstance(tree, dict):
                raise NirError(f"not a NIR file: its 'node' is no group; {REMEDY}")
            return tree, reader.arrays
    except NirError:
        raise
    except MemoryError as error:
        raise NirError(f"needs too much memory and may be damaged; {REMEDY}") from error
    except Exception as error:  # h5py fails in many ways on damaged files
        raise NirError(f"damaged ({type(error).__name__}); {REMEDY}") from error


class _Reader:
    """Reads groups and datasets within the limits for a file."""

    def __init__(self):
        self.arrays = {}
        self.numbers, self.objects = MAX_NUMBERS, MAX_OBJECTS

    def group(self, names, group, parents=()):
        if len(parents) > MAX_DEPTH:
            raise NirError(f"has groups more than {MAX_DEPTH} deep; {REMEDY}")
        found = {}
        for name in names:
            self.objects -= 1
            if self.objects < 0:
                raise NirError(f"has more than the {MAX_OBJECTS} entries that can be read")
            where = _where(parents, name)
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise NirError(f"{where} is a link to another place; {REMEDY}")
            member = group[name]
            if isinstance(member, h5py.Group):
                found[name] = self.group(member, member, (*parents, name))
            elif isinstance(member, h5py.Dataset):
                found[name] = self.dataset(where, member)
            else:
                raise NirError(f"{where} is a {type(member).__name__}; {REMEDY}")
        return found

    def dataset(self, where, dataset):
        if dataset.is_virtual or dataset.external:
            raise NirError(f"{where} is kept in another file; {REMEDY}")
        if unusual_filters(dataset):
            raise NirError(f"{where} is compressed with a plug-in, which is not loaded; {REMEDY}")
        if dataset.shape is None:
            return ["text", ""]
        size = 1
        for n in dataset.shape:
            size *= n
        self.numbers -= size
        if self.numbers < 0:
            raise NirError(
                f"{where} exceeds the {MAX_NUMBERS} numbers that can be read from a file; give a "
                "smaller network"
            )
        if h5py.check_string_dtype(dataset.dtype) is not None:
            long = f"{where} is a text that is too long; {REMEDY}"
            if size > MAX_OBJECTS or size * dataset.dtype.itemsize > MAX_FILE:
                raise NirError(long)
            texts = np.asarray(dataset.asstr()[()], object)
            if any(len(text) > MAX_TEXT for text in texts.ravel()):
                raise NirError(long)
            return ["text", texts.tolist()]
        if dataset.dtype.kind not in "fiub" or dataset.dtype.itemsize > 8:
            raise NirError(f"{where} has type {dataset.dtype}, not numbers; {REMEDY}")
        key = str(len(self.arrays))
        self.arrays[key] = np.asarray(dataset[()])
        return ["array", key]


def _filled(tree, arrays):
    if isinstance(tree, dict):
        return {name: _filled(value, arrays) for name, value in tree.items()}
    kind, value = tree
    return arrays[value] if kind == "array" else value


def _answer(content):
    try:
        tree, arrays = read_content(content)
    except NirError as error:
        return {"problem": str(error)}, {}
    return {"tree": tree}, arrays


if __name__ == "__main__":
    answer_apart(_answer)
