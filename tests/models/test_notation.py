import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.notation import Architecture, Conv, NotationError, parse


def test_the_papers_networks():
    cnn = parse("10x10-6c4-24c3-10o")
    assert cnn == Architecture((10, 10, 1), (Conv(6, 4), Conv(24, 3)), 10)
    assert cnn.shapes == ((10, 10, 1), (7, 7, 6), (5, 5, 24))
    slayer = parse("10x10x2-6c2-24c3-10o")
    assert slayer.shapes == ((10, 10, 2), (9, 9, 6), (7, 7, 24))


def test_multiplication_sign_and_spaces():
    assert parse("10×10×2 - 6c2 - 10o") == parse("10x10x2-6c2-10o")


def test_weights_of_the_papers_network_by_hand():
    shapes = parse("10x10-6c4-24c3-10o").weight_shapes
    assert shapes == {
        "conv1.kernel": (4, 4, 1, 6),
        "conv1.bias": (6,),
        "conv2.kernel": (3, 3, 6, 24),
        "conv2.bias": (24,),
        "output.kernel": (600, 10),
        "output.bias": (10,),
    }


@pytest.mark.parametrize(
    ("text", "token", "problem"),
    [
        ("", "token 1 ('')", "input's size"),
        ("6c4-10o", "token 1 ('6c4')", "input's size"),
        ("10-6c4-10o", "token 1 ('10')", "input's size"),
        ("10x10x2x2-10o", "token 1 ('10x10x2x2')", "input's size"),
        ("0x10-10o", "token 1 ('0x10')", "dimension of zero"),
        ("10x10x0-10o", "token 1 ('10x10x0')", "dimension of zero"),
        ("10x10", "token 1 ('10x10')", "output layer"),
        ("10x10-6c4", "token 2 ('6c4')", "output layer"),
        ("10x10-10o-6c4", "token 3 ('6c4')", "output layer"),
        ("10x10-10o-", "token 3 ('')", "output layer"),
        ("10x10-6c4-1o", "token 3 ('1o')", "at least 2"),
        ("10x10-6p2-10o", "token 2 ('6p2')", "must be a convolution"),
        ("10x10--10o", "token 2 ('')", "must be a convolution"),
        ("10x10-6C4-10o", "token 2 ('6C4')", "must be a convolution"),
        ("10x10-10o-10o", "token 2 ('10o')", "must be a convolution"),
        ("10x10-0c4-10o", "token 2 ('0c4')", "zero"),
        ("10x10-6c0-10o", "token 2 ('6c0')", "zero"),
        ("10x10-6c11-10o", "token 2 ('6c11')", "does not fit"),
        ("10x10-6c8-6c4-10o", "token 3 ('6c4')", "3x3 input"),
        ("10x3-6c4-10o", "token 2 ('6c4')", "does not fit"),
    ],
)
def test_an_error_names_its_token(text, token, problem):
    with pytest.raises(NotationError) as caught:
        parse(text)
    assert token in str(caught.value)
    assert problem in str(caught.value)


@given(
    size=st.tuples(st.integers(4, 40), st.integers(4, 40), st.integers(1, 3)),
    convs=st.lists(st.tuples(st.integers(1, 64), st.integers(1, 2)), max_size=3),
    outputs=st.integers(2, 100),
)
def test_writing_and_reading_gives_the_same(size, convs, outputs):
    architecture = Architecture(size, tuple(Conv(*c) for c in convs), outputs)
    assert parse(str(architecture)) == architecture
    for shape in architecture.shapes:
        assert min(shape) >= 1
