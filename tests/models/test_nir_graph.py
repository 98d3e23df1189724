"""NIR files and graphs are read as data, and what cannot be used is refused by name."""

import itertools

import h5py
import numpy as np
import pytest

from deploy.errors import UserError
from models.nir.errors import NirError
from models.nir.graph import read_nir
from tests.command import missing
from tests.models.nir_graphs import Graph, affine, conv, lif, network_of, tree_of

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
    flatten = "Flatten", {"start_dim": 0, "end_dim": -1}  # as in snnTorch's own example
    assert network_of((1, 4), flatten, affine(rng, 3, 4), lif()).input_shape == (4,)


def edited(change):
    rng = np.random.default_rng(0)
    tree = tree_of((2, 5, 5), conv(rng, 3, 2, 3), lif(), ("Flatten", {"start_dim": 0}),
                   affine(rng, 4, 27), output=[4])  # fmt: skip
    change(tree["nodes"], tree["edges"], tree)
    return Graph(tree)


def put(node, **values):
    return lambda nodes, edges, tree: nodes[node].update(values)


def loop_over(*between):
    """The neurons' connection to themselves through these nodes."""

    def change(nodes, edges, tree):
        names = [f"back{n}" for n in range(len(between))]
        nodes.update(zip(names, between, strict=True))
        edges += itertools.pairwise(["n1", *names, "n1"])

    return change


CONV_BACK = {"type": "Conv2d", "weight": np.ones((3, 3, 3, 3)), "padding": 1}
WEIGHTS_BACK = {"type": "Linear", "weight": np.eye(27)}


def input_through_the_loop(nodes, edges, tree):
    """As Spyx writes its recurrent layers."""
    nodes["back"] = WEIGHTS_BACK
    edges.remove(("n0", "n1"))
    edges += [("n0", "back"), ("back", "n1"), ("n1", "back")]


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
    "a loop with a convolution": (loop_over(CONV_BACK), "'n1' (LIF)", "'back0'", "Linear"),
    "a loop with a delay": (
        loop_over(WEIGHTS_BACK, {"type": "Delay", "delay": 1.0}),
        *("'n1' (LIF)", "'back0'", "delays"),
    ),
    "a loop of another size": (loop_over({"type": "Linear", "weight": np.eye(3)}), "'back0'", "27"),
    "a loop over two layers": (lambda n, e, t: e.append(("n3", "n1")), "'n3' (Affine)", "'n1'"),
    "itself": (lambda n, e, t: e.append(("n1", "n1")), "'n1' (LIF)", "itself"),
    "an input through the loop": (input_through_the_loop, "'back'", "connect 'n0' to 'n1'"),
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
}


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_used_is_named(what):
    change, *facts = BAD[what]
    graph = edited(change)
    with pytest.raises(NirError) as caught:
        read_nir(graph)
    assert missing(str(caught.value), *facts) == []


def test_files_that_are_no_nir(tmp_path, path):
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
    for name, content in (("text", b"hello"), ("empty", b""), ("half", path.read_bytes()[:900])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(NirError, match=name):
            read_nir(tmp_path / name)
    (tmp_path / "pointer").write_bytes(pointer)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with h5py.File(tmp_path / "cut.nir", "w") as file:  # as after a failed export
        file["node/nodes/0/type"] = b"LIF"
    facts = {
        "other.h5": "'?node",
        "cut.nir": "without edges",
        "pointer": "git lfs pull",
        "missing": "path",
        ".": "directory",
    }
    for name, fact in facts.items():
        with pytest.raises(UserError, match=f"^{tmp_path / name}: .*{fact}"):
            read_nir(tmp_path / name)


def recurrent_tree(kind="Affine", times=1):
    rng = np.random.default_rng(0)
    tree = tree_of((6,), affine(rng, 4, 6), lif(), affine(rng, 3, 4))
    for number in range(times):
        name, values = f"n1.w_rec{number}", affine(rng, 4, 4, bias=1.0)[1]
        tree["nodes"][name] = {"type": kind, **values}
        tree["edges"] += [("n1", name), (name, "n1")]
    return tree


@pytest.mark.parametrize("kind", ["Linear", "Affine"])
def test_a_layer_connected_to_itself(kind):
    tree = recurrent_tree(kind)
    network = read_nir(Graph(tree))
    assert [node.name for node in network.nodes] == ["n0", "n1", "n2"]
    loop = network.nodes[1].loop
    assert (loop.name, loop.kind, loop.shape) == ("n1.w_rec0", kind, (4,))
    np.testing.assert_array_equal(loop["weight"], tree["nodes"]["n1.w_rec0"]["weight"])


def test_a_layer_connected_to_itself_in_a_subgraph():
    rng = np.random.default_rng(0)
    inner = tree_of((4,), lif())
    inner["nodes"]["w_rec"] = {"type": "Linear", "weight": np.eye(4)}
    inner["edges"] += [("n0", "w_rec"), ("w_rec", "n0")]
    network = read_nir(Graph(tree_of((6,), affine(rng, 4, 6), ("NIRGraph", inner))))
    assert [node.name for node in network.nodes] == ["n0", "n1.n0"]
    assert network.nodes[1].loop.name == "n1.w_rec"
