"""NIR files, whole and damaged: other values, other shapes, other edges, what HDF5 can hide."""

import io
import json

import h5py
import numpy as np

from deploy.check.bundle import read_bundle
from deploy.network.nir import write_nir

from ..models.nir_graphs import affine, conv, cuba_lif, lif, tree_of
from . import damage
from .damage import pick

TINY = (
    *("--set", "data.samples_per_digit=60", "--set", "presentation.steps=20"),
    *("--samples", "10", "--jobs", "1"),
)
"""The base's recordings, and little work with them."""


def graph(rng, folder, base):
    """A NIR graph with something wrong in it, for a run on the base's recordings."""
    path, way = folder / "network.nir", rng.random()
    (folder / "cache").symlink_to(base.run.parent / "cache")
    if way < 0.15:
        write_nir(path, read_bundle(base.run / "bundle").spec)
        _hide(rng, path) if rng.random() < 0.6 else _change(rng, path)
    else:
        tree = _tree(rng)
        for _ in range(int(rng.choice([0, 1, 1, 2]))):
            tree = WAYS[int(rng.integers(0, len(WAYS)))](rng, tree)
        path.write_bytes(written(tree))
        if way > 0.9:
            _hide(rng, path)
    if rng.random() < 0.15:
        path.write_bytes(damage.some_bytes(rng, path.read_bytes()))
    more = [[], [], ["--step", 5], ["--input", "image"], ["--input", "events"]]
    return ["convert", folder / "run", "--nir", path, *TINY, *more[int(rng.integers(0, len(more)))]]


def written(tree) -> bytes:
    """The bytes of a NIR file of a graph, as ``nir.write`` writes it."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file["version"] = "1.0"
        _group(file.create_group("node"), tree)
    return buffer.getvalue()


def _group(group, values):
    for name, value in values.items():
        name = name.replace("/", "-").replace("\0", "-")
        if name in (*group, "", "."):
            name += "-"
        if isinstance(value, dict):
            _group(group.create_group(name), value)
        elif isinstance(value, str):
            group[name] = value.replace("\0", "-").encode("utf-8", "surrogatepass")
        elif name == "edges" and np.asarray(value).dtype.kind in "UOS":
            group.create_dataset(name, data=np.array(value, object), dtype=h5py.string_dtype())
        elif value is not None:
            group[name] = value


def _tree(rng):
    """A chain that fits the base's recordings, on events or on images."""
    channels = int(rng.integers(1, 3))
    some = [("Flatten", {"start_dim": 0, "end_dim": -1})] if rng.random() < 0.4 else [
        ("AvgPool2d", {"kernel_size": 2, "stride": 2, "padding": 0}),
        conv(rng, 3, channels, 3, bias=0.1),
        cuba_lif(0.004, 0.01, 12.0),
        ("Flatten", {"start_dim": 0, "end_dim": -1}),
    ]  # fmt: skip
    inputs = 100 * channels if len(some) == 1 else 27
    return tree_of(
        (channels, 10, 10), *some, affine(rng, 6, inputs), lif(0.02, 8.0), affine(rng, 10, 6)
    )


def _values(rng, tree):
    """A parameter of a node becomes another number, text or array."""
    nodes = list(tree["nodes"].values())
    node = nodes[int(rng.integers(0, len(nodes)))]
    name = list(node)[int(rng.integers(0, len(node)))]
    way, array = rng.integers(0, 7), node[name]
    if way == 0:
        del node[name]
    elif way == 1:
        node[name] = pick(rng, damage.TEXTS)
    elif way == 2 and not isinstance(array, (str, dict)):
        array = np.array(array, float)
        array.flat[int(rng.integers(0, max(array.size, 1)))] = float(pick(rng, damage.NUMBERS))
        node[name] = array
    elif way == 3 and not isinstance(array, (str, dict)):
        node[name] = np.resize(array, [int(n) for n in rng.integers(0, 4, rng.integers(0, 4))])
    elif way > 4 and not isinstance(array, (str, dict)):  # often still a network
        node[name] = np.array(array, float) * 10.0 ** rng.uniform(-320, 9)
    else:
        node[name] = float(pick(rng, damage.NUMBERS))
    return tree


def _edges(rng, tree):
    """Cycles, branches, ends that are no nodes, and what are no edges."""
    edges, names = list(tree["edges"]), list(tree["nodes"])
    way = rng.integers(0, 6)
    if way == 0:
        edges.append((pick(rng, names), pick(rng, names)))
    elif way == 1:
        del edges[int(rng.integers(0, len(edges)))]
    elif way == 2:
        edges = [(a, b) for a in names for b in names]
    elif way == 3:
        edges.append((pick(rng, names), pick(rng, damage.TEXTS[:4])))
    elif way == 4:
        edges = pick(rng, [5.0, np.zeros((3, 2)), np.zeros((2, 2, 2)), "x", [], {}, [["input"]]])
    else:
        edges = edges * int(rng.integers(2, 200))
    return {**tree, "edges": edges}


def _many(rng, tree):
    """Graphs within the graph, many or deep; long chains; an input of any shape."""
    way = int(rng.integers(0, 4))
    if way == 0:  # deeper and deeper
        for _ in range(int(rng.integers(1, 14))):
            tree = tree_of((2, 10, 10), ("NIRGraph", tree))
    elif way == 1:  # a chain of many nodes, in graphs that none of is too large
        inner = tree_of((10,), *[("Scale", {"scale": 1.0})] * int(rng.choice([20, 300])))
        nodes = [("NIRGraph", inner)] * int(rng.choice([3, 28]))
        tree = tree_of((10,), *nodes, lif(0.02, 8.0))
    elif way == 2:  # every node leads to every graph, which leads to every node
        inner = tree_of((10,))
        tree = tree_of((10,), *[lif()] * 40, *[("NIRGraph", inner)] * 20)
        names = list(tree["nodes"])
        tree["edges"] = [(a, b) for a in names for b in names]
    else:
        tree["nodes"]["input"]["shape"] = pick(
            rng, [np.array([np.inf]), np.array([-1, 10, 10]), np.array([2.5, 10, 10]), np.zeros(0),
                  np.zeros((0, 3)), np.array([10**9] * 3), np.array([2**62, 4, 1])])  # fmt: skip
    return tree


def _kind(rng, tree):
    """A node of another kind, of one that is not known, or with a name of any characters."""
    names = list(tree["nodes"])
    name = pick(rng, names)
    if rng.random() < 0.5:
        kinds = ["IF", "LI", "CubaLI", "Threshold", "SumPool2d", "Conv1d", "NIRGraph", "Input", "",
                 "Delay", "I", "x" * 3000, "\x1b[2J"]  # fmt: skip
        tree["nodes"][name] = {**tree["nodes"][name], "type": pick(rng, kinds)}
        return tree
    new = pick(rng, ["\x1b[2J", "n" * 1000, "ß", "a.b", "."])
    named = {new if n == name else n: node for n, node in tree["nodes"].items()}
    edges = [tuple(new if n == name else n for n in pair) for pair in tree["edges"]]
    return {**tree, "nodes": named, "edges": edges}


WAYS = (_values, _values, _edges, _many, _kind)


def _change(rng, path):
    """Another text or number in a graph that was exported here, whose metadata say so."""
    with h5py.File(path, "r+") as file:
        metadata = file["node/metadata"]
        name = pick(rng, sorted(metadata))
        if name == "deployed" or rng.random() < 0.5:
            text = metadata["deployed"][()]
            del metadata["deployed"]
            changed = damage.json_text(rng, json.loads(text)).replace(b"\0", b"-")
            metadata["deployed"] = changed
        else:
            del metadata[name]
            metadata[name] = pick(rng, [0.0, -1.0, np.nan, np.zeros(3), "x", 1e300])


def _hide(rng, path):
    """What HDF5 can have in the place of an array: links, other files, filters, any size."""
    with h5py.File(path, "r+") as file:
        places = []
        file.visititems(lambda name, item: places.append(name))
        place = pick(rng, [name for name in places if name.startswith("node/")] or ["node"])
        del file[place]
        way = int(rng.integers(0, 11))
        if way == 0:
            file[place] = h5py.ExternalLink(pick(rng, ["/etc/passwd", "/dev/zero", "x"]), "/")
        elif way == 1:
            file[place] = h5py.SoftLink(pick(rng, ["/node", "/nowhere", place]))
        elif way == 2:
            file[place] = file["/"]  # a hard link to itself: a group without end
        elif way == 3:
            outside = [(pick(rng, ["/etc/passwd", "/dev/zero"]), 0, h5py.h5f.UNLIMITED)]
            file.create_dataset(place, (10, 10), "u1", external=outside)
        elif way == 4:
            layout = h5py.VirtualLayout((10, 10), "f8")
            layout[:] = h5py.VirtualSource("/etc/passwd", "x", (10, 10))
            file.create_virtual_dataset(place, layout)
        elif way == 5:
            shape = pick(rng, [(30_000_000,), (10**12,), (5000, 5000), (2**31, 2**31)])
            kind = pick(rng, ["f8", "u1", h5py.string_dtype(), "S1000000", "O"][:4])
            chunks = tuple(min(n, 1000) for n in shape) if kind != "S1000000" else (1,) * len(shape)
            file.create_dataset(place, shape, kind, chunks=chunks)
        elif way == 6:
            kinds = [np.dtype([("a", "f8"), ("b", "S5")]), "c16", h5py.ref_dtype, "V8",
                     h5py.vlen_dtype("f8"), h5py.enum_dtype({"a": 1}), "f2", "?"]  # fmt: skip
            file.create_dataset(place, (3,), pick(rng, kinds))
        elif way == 7:
            plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plan.set_chunk((10,))
            plan.set_filter(32_015, h5py.h5z.FLAG_OPTIONAL)
            space = h5py.h5s.create_simple((10,))
            h5py.h5d.create(file.id, place.encode(), h5py.h5t.NATIVE_INT32, space, plan)
        elif way == 8:
            file[place] = np.dtype("f8")  # a named type
        elif way == 9:
            file.create_dataset(place, data=h5py.Empty("f8"))
        else:
            inner = file
            for _ in range(int(rng.choice([20, 2000]))):
                inner = inner.create_group(place if inner is file else "a")
