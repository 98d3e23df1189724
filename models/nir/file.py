"""NIR files (HDF5) as plain values.

The package ``nir`` refuses graphs whose declared shapes contradict their weights, which some
exporters write, and follows links to other files; this reader ignores the former and refuses the
latter.
"""

import io

import h5py

from deploy import limits
from deploy.errors import shorten_error
from deploy.files import POINTER_PROBLEM, is_pointer
from models.nir.errors import NirError, quote

# Maximum number of groups within groups of a file.
MAX_DEPTH = 20


def read_tree(content: bytes) -> dict:
    """The graph of a file's content, as ``to_dict`` of the package ``nir`` has it.

    Raises
    ------
    NirError
        The content is not a NIR graph, is damaged, or has links or arrays above
        :data:`deploy.limits.ARRAY_BYTES`.
    """
    if is_pointer(content):
        raise NirError(POINTER_PROBLEM)
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            tree = _read_group(file["node"])
            missing = {"edges", "nodes"} - tree.keys()
            if missing:
                raise NirError(
                    f"a graph without {' and '.join(sorted(missing))}; export the network again, "
                    "with a version of the package that can export all of its layers"
                )
    except NirError:
        raise
    except Exception as error:  # h5py fails in many ways on other and damaged files
        reason = shorten_error(error, 200)
        raise NirError(
            f"not a NIR graph, or a damaged one ({reason}); write it with nir.write(path, graph)"
        ) from error
    return tree


def _read_group(group, depth=0) -> dict:
    if depth > MAX_DEPTH:
        raise NirError(f"has more than {MAX_DEPTH} groups within groups; write the graph again")
    values = {}
    for name in group:
        is_here = isinstance(group.get(name, getlink=True), h5py.HardLink)
        item = group[name] if is_here else None
        if isinstance(item, h5py.Group):
            values[name] = _read_group(item, depth + 1)
        elif isinstance(item, h5py.Dataset) and item.nbytes <= limits.ARRAY_BYTES:
            values[name] = item[()]
        else:
            raise NirError(f"{quote(name)} is a link or too large; write the graph again")
    return values
