"""NIR files and graphs are read as data, and what cannot be used is refused by name."""

import io

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import apart
from models.nir_file import read_nir_file
from models.nir_graph import NirError, read_nir
from tests.command import missing
from tests.models.nir_graphs import (
    Graph,
    affine,
    conv,
    cuba_lif,
    lif,
    network_of,
    tree_of,
)

nir = pytest.importorskip("nir")


def small_graph():
    return nir.NIRGraph.from_list(
        nir.Input({"input": np.array([2, 6, 6])}),
        nir.Conv2d((6, 6), np.ones((3, 2, 3, 3)), 1, 0, 1, 1, np.zeros(3)),
        nir.LIF(*(np.full((3, 4, 4), x) for x in (0.02, 1.0, 0.0, 1.0))),
        nir.Flatten({"input": np.array([3, 4, 4])}, 0),
        nir.Affine(np.ones((5, 48)), np.zeros(5)),
        nir.LI(*(np.full(5, x) for x in (0.05, 1.0, 0.0))),
        nir.Output({"output": np.array([5])}),
    )


@pytest.fixture
def path(tmp_path):
    nir.write(tmp_path / "small.nir", small_graph())
    return tmp_path / "small.nir"


def test_a_file_and_a_graph_in_memory_are_the_same_network(path):
    from_file, in_memory = read_nir(path), read_nir(small_graph())
    assert [n.kind for n in from_file.nodes] == ["Conv2d", "LIF", "Flatten", "Affine", "LI"]
    assert [n.shape for n in from_file.nodes] == [(3, 4, 4), (3, 4, 4), (48,), (5,), (5,)]
    assert from_file.input_shape == in_memory.input_shape == (2, 6, 6)
    for one, other in zip(from_file.nodes, in_memory.nodes, strict=True):
        assert one.parameters.keys() == other.parameters.keys()
        for name, value in one.parameters.items():
            np.testing.assert_array_equal(value, other[name])


def test_graphs_within_the_graph_are_opened():
    rng = np.random.default_rng(0)
    inner = tree_of((4,), lif(), affine(rng, 3, 4))
    tree = tree_of((6,), affine(rng, 4, 6), ("NIRGraph", inner), lif())
    tree["nodes"]["n1"]["type"] = "NIRGraph"
    network = read_nir(Graph(tree))
    assert [n.name for n in network.nodes] == ["n0", "n1.n0", "n1.n1", "n2"]


def test_one_value_stands_for_all_neurons():
    network = network_of((4,), affine(np.random.default_rng(0), 3, 4), lif(0.03))
    assert network.nodes[1]["tau"].tolist() == [0.03] * 3


def test_a_dimension_for_samples_is_left_out():
    rng = np.random.default_rng(0)
    assert network_of((1, 4), affine(rng, 3, 4), lif()).input_shape == (4,)
    assert network_of((1, 2, 5, 5), conv(rng, 3, 2, 3), lif()).input_shape == (2, 5, 5)


def test_snntorchs_exporter_is_recognised():
    """A share of 0.9 that is kept: tau = 1e-4 / 0.1 and r = tau / 1e-4."""
    rng = np.random.default_rng(0)
    assert network_of((4,), affine(rng, 3, 4), lif(1e-3, 10.0)).written_by_snntorch
    assert not network_of((4,), affine(rng, 3, 4), lif(1e-3, 1.0)).written_by_snntorch
    synaptic = cuba_lif(5e-4, 1e-3, 10.0, w_in=5.0)
    assert network_of((4,), affine(rng, 3, 4), synaptic).written_by_snntorch


def edited(change):
    rng = np.random.default_rng(0)
    tree = tree_of((2, 5, 5), conv(rng, 3, 2, 3), lif(), ("Flatten", {"start_dim": 0}),
                   affine(rng, 4, 27), output=[4])  # fmt: skip
    change(tree["nodes"], tree["edges"], tree)
    return Graph(tree)


def put(node, **values):
    return lambda nodes, edges, tree: nodes[node].update(values)


def recurrent(nodes, edges, tree):
    nodes["back"] = {"type": "Linear", "weight": np.eye(3)}
    edges += [("n1", "back"), ("back", "n1")]


def second_input(nodes, edges, tree):
    nodes["other"] = {"type": "Input", "shape": np.array([4])}


def branch(nodes, edges, tree):
    nodes["side"] = {"type": "Scale", "scale": np.ones(4)}
    edges.append(("n3", "side"))


def no_neurons(nodes, edges, tree):
    nodes["n1"] = {"type": "Scale", "scale": 2.0}


def no_edges(nodes, edges, tree):
    edges.clear()


def without(node, name):
    return lambda nodes, edges, tree: nodes[node].pop(name)


BAD = {
    "recurrence": (recurrent, "'n1' (LIF)", "'back'"),
    "itself": (lambda n, e, t: e.append(("n1", "n1")), "'n1' (LIF)", "itself"),
    "two inputs": (second_input, "2 nodes", "Input"),
    "no output": (put("output", type="Scale"), "0 nodes", "Output"),
    "branch": (branch, "'n3'", "'output'", "'side'"),
    "no edges": (no_edges, "'input'"),
    "an edge to nowhere": (lambda n, e, t: e.append(("n1", "x")), "'x'"),
    "unknown node": (put("n1", type="Delay"), "node 'n1': ", "'Delay'"),
    "unheard-of node": (put("n1", type="Sigma"), "node 'n1': ", "'Sigma'"),
    "no neurons": (no_neurons, "neurons", "LIF, CubaLIF or IF"),
    "NaN": (put("n3", weight=np.full((4, 27), np.nan)), "node 'n3' (Affine): ", "weight", "NaN"),
    "infinite": (put("n1", tau=np.inf), "node 'n1' (LIF): ", "tau", "infinite"),
    "negative time": (put("n1", tau=-0.1), "node 'n1' (LIF): ", "tau", " 0"),
    "shapes": (put("n3", weight=np.ones((4, 9))), "node 'n3' (Affine): ", " 9 ", " 27"),
    "channels": (put("n0", weight=np.ones((3, 1, 3, 3))), "node 'n0' (Conv2d): ", " 1 ", " 2"),
    "parameters": (put("n1", v_threshold=np.ones(7)), "node 'n1' (LIF): ", "v_threshold", "(7,)"),
    "threshold": (put("n1", v_threshold=0.0), "node 'n1' (LIF): ", "v_threshold", "v_reset"),
    "kernel": (put("n0", weight=np.ones((3, 2, 7, 7))), "node 'n0' (Conv2d): ", "kernel"),
    "stride": (put("n0", stride=0), "node 'n0' (Conv2d): ", "stride", " 1"),
    "text": (put("n0", weight="a lot"), "node 'n0' (Conv2d): ", "weight", "array"),
    "missing": (without("n1", "tau"), "node 'n1' (LIF): ", "tau"),
    "input's shape": (put("input", shape=np.array([0, 5, 5])), "node 'input' (Input): ", "shape"),
    "no nodes": (lambda n, e, t: t.update(nodes={"a": 1}), "nir.NIRGraph", "nodes"),
    "wild edges": (lambda n, e, t: t.update(edges=["ab", 3]), "nir.NIRGraph", "edges"),
}


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_used_is_named(what):
    change, *facts = BAD[what]
    graph = edited(change)
    with pytest.raises(NirError) as caught:
        read_nir(graph)
    assert missing(str(caught.value), *facts) == []


def test_files_that_are_no_nir(tmp_path, path):
    for name, content in (("text", b"hello"), ("empty", b""), ("half", path.read_bytes()[:900])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(NirError, match=name):
            read_nir(tmp_path / name)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    for name, fact in (("other.h5", "'node'"), ("missing", "path"), (".", "folder")):
        with pytest.raises(NirError, match=f"^{tmp_path / name}: .*{fact}"):
            read_nir(tmp_path / name)
    with pytest.raises(NirError, match=r"'a\\x00b'"):
        read_nir("a\0b")


def test_links_out_of_the_file_and_plugins_are_refused(tmp_path, path):
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["weight"] = np.ones((5, 48))

    def with_weight(name, add):
        copy = tmp_path / name
        copy.write_bytes(path.read_bytes())
        with h5py.File(copy, "r+") as file:
            group = next(g for g in file["node/nodes"].values() if g["type"][()] == b"Affine")
            del group["weight"]
            add(group)
        return copy

    raw = tmp_path / "raw"
    raw.write_bytes(b"\0" * 8 * 240)
    layout = h5py.VirtualLayout((5, 48), float)
    layout[:] = h5py.VirtualSource(secret, "weight", (5, 48))
    ways = {
        "external link": lambda g: g.__setitem__("weight", h5py.ExternalLink(secret, "weight")),
        "soft link": lambda g: g.__setitem__("weight", h5py.SoftLink("/version")),
        "external storage": lambda g: g.create_dataset(
            "weight", (5, 48), float, external=[(raw, 0, 8 * 240)]
        ),
        "virtual": lambda g: g.create_virtual_dataset("weight", layout),
        "filter": lambda g: g.create_dataset("weight", data=np.ones((5, 48)), compression="lzf"),
    }
    for name, add in ways.items():
        with pytest.raises(NirError, match=r"node 'affine': .*'weight'"):
            read_nir(with_weight(name, add))


def test_a_node_that_is_a_link_is_named(path):
    with h5py.File(path, "r+") as file:
        del file["node/nodes/lif"]
        file["node/nodes/lif"] = h5py.SoftLink("/node/nodes/affine")
    with pytest.raises(NirError, match="node 'lif'"):
        read_nir(path)


def test_a_group_within_itself_ends(path):
    with h5py.File(path, "r+") as file:
        file["node/nodes/again"] = file["node"]
    with pytest.raises(NirError, match=" 12 "):
        read_nir(path)


def test_huge_arrays_are_not_made(path):
    with h5py.File(path, "r+") as file:
        file.create_dataset("node/nodes/huge", (10**6, 10**6), float, chunks=(10, 10))
    with pytest.raises(NirError, match=r"node 'huge' .* 30000000 "):
        read_nir(path)


@pytest.mark.parametrize(("count", "kind"), [(10**6, h5py.string_dtype()), (500, "S1000000")])
def test_texts_without_end_are_not_read(path, count, kind):
    """A few bytes that say so are a million texts, or 500 MB."""
    with h5py.File(path, "r+") as file:
        file.create_dataset("node/nodes/texts", (count,), kind, chunks=(1,))
    with pytest.raises(NirError, match="node 'texts'"):
        read_nir(path)


def passing_graphs(count):
    """Graphs of nothing but an input and an output, each connected to all of them."""
    tree = tree_of((4,), *[("NIRGraph", tree_of((4,)))] * count)
    names = list(tree["nodes"])
    return {**tree, "edges": [(a, b) for a in names for b in names]}


LONG = tree_of((4,), *[("Scale", {"scale": 1.0})] * 300)


@pytest.mark.parametrize(
    ("tree", "told"),
    [
        (passing_graphs(20), "'n0'.* itself"),
        (tree_of((4,), ("NIRGraph", LONG), ("NIRGraph", LONG)), "500 nodes"),
        ({**tree_of((4,), lif()), "edges": 5.0}, "edges"),
        ({**tree_of((4,), lif()), "edges": np.zeros((2, 2, 2))}, "edges"),
        ({**tree_of((4,), lif()), "edges": np.zeros((20_000, 2))}, "10000 edges"),
        (tree_of((np.inf,), lif()), "Input"),
        (tree_of((4,), ("Flatten", {"start_dim": [0, 0]}), lif()), "start_dim"),
        (tree_of((4,), ("Flatten", {"start_dim": 0.5}), lif()), "start_dim"),
    ],
    ids=range(8),
)
def test_graphs_of_odd_parts_are_refused(tree, told):
    with pytest.raises(NirError, match=told):
        read_nir(Graph(tree))


def test_nodes_of_nodes_that_all_lead_to_each_other_do_not_multiply():
    """Each graph that only passes on is replaced by edges from all before it to all after it."""
    tree = tree_of((4,), *[lif()] * 60, ("NIRGraph", tree_of((4,))), *[lif()] * 60)
    names = list(tree["nodes"])
    tree["edges"] = [(a, "n60") for a in names[1:61]] + [("n60", b) for b in names[62:-1]]
    with pytest.raises(NirError, match=r"60 .* 60 "):
        read_nir(Graph(tree))


def test_a_crash_of_the_reading_process_is_a_line(path, monkeypatch, tmp_path):
    package = tmp_path / "models"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "nir_file.py").write_text("import os\nos.abort()\n")
    monkeypatch.setattr(apart, "__file__", str(package / "apart.py"))
    with pytest.raises(NirError, match=f"^{path}: "):
        read_nir(path)


@given(st.data())
@settings(max_examples=15, deadline=None)
def test_damaged_files_are_read_or_refused(tmp_path_factory, data):
    buffer = io.BytesIO()
    nir.write(buffer, small_graph())
    content = bytearray(buffer.getvalue())
    for _ in range(data.draw(st.integers(1, 20))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "graph.nir"
    path.write_bytes(content)
    try:
        read_nir(path)
    except NirError as error:  # not because reading it did not begin, or did not end
        assert "could not be read in" not in str(error)  # noqa: PT017


def test_reading_needs_no_package_nir(path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "nir", None)
    assert len(read_nir_file(path)["nodes"]) == 7
