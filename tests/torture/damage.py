"""Ways to damage bytes, JSON values and arrays, each drawn from a generator."""

import copy
import json
import math

import numpy as np

NUMBERS = (
    0, -1, 1, 2, 7, 10, 255, 256, 2**15, 10**5, 10**6, 10**9, 2**31 - 1, 2**31, 2**53, 2**63, 2**64,
    10**22, 2**70, -(2**63), 0.5, -0.5, 1e-300, 1e300, 5e-324,
    math.nan, math.inf, -math.inf,
)  # fmt: skip
OTHERS = (None, True, False, "", "x", "0", "\x00", "ß", "a" * 10_000, [], [0], [[]], {}, {"a": 1})
TEXTS = ("", "x", "..", "/etc/passwd", "\ud800", "a" * 5000, "10x10-10o", "\x1b[2J", "nan", "lif")


def some_bytes(rng, content):
    """Flip, overwrite, cut, repeat, insert or append bytes."""
    content = bytearray(content)
    for _ in range(int(rng.choice([1, 1, 1, 2, 5, 30]))):
        place = int(rng.integers(0, max(1, len(content))))
        way = rng.integers(0, 9)
        if way == 0 and content:
            content[place] ^= 1 << int(rng.integers(0, 8))
        elif way == 1 and content:
            content[place] = int(rng.integers(0, 256))
        elif way == 2:
            del content[place:]
        elif way == 3:
            part = content[place : place + int(rng.integers(1, 200))]
            content[place:place] = part
        elif way == 4:
            content[place:place] = rng.bytes(int(rng.integers(1, 40)))
        elif way == 5:
            del content[place : place + int(rng.integers(1, 40))]
        elif way == 6:
            size = int(rng.choice([1, 2, 4, 8]))
            content[place : place + size] = rng.choice([b"\x00", b"\xff", b"\x7f"]) * size
        elif way == 7:
            value = int(rng.choice([0, 1, 8, 14, 15, 19, 100, 2**16, 10**6, 2**31 - 1, 2**32 - 1]))
            place -= place % 4
            content[place : place + 4] = value.to_bytes(4, str(rng.choice(["little", "big"])))
        else:
            content += rng.bytes(int(rng.integers(1, 2000)))
    return bytes(content)


def value(rng, given):
    """Change one place of a JSON value to another of its kind or of another kind."""
    given = copy.deepcopy(given)
    places = list(_places(given))
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        holder, key = places[int(rng.integers(0, len(places)))]
        way = rng.integers(0, 6)
        try:
            if way == 0:
                del holder[key]
            elif way == 1 and isinstance(holder, dict):
                holder[f"{key}x"] = holder[key]
            elif way == 2:
                holder[key] = pick(rng, OTHERS)
            elif way == 3 and isinstance(holder[key], list) and holder[key]:
                holder[key] = holder[key] * int(rng.integers(2, 40))
            elif isinstance(holder[key], str):
                holder[key] = pick(rng, TEXTS)
            else:
                holder[key] = pick(rng, NUMBERS)
        except (KeyError, IndexError):
            continue
    return given


def json_text(rng, given):
    """The bytes of a JSON file with something wrong in it."""
    if rng.random() < 0.15:
        return some_bytes(rng, json.dumps(given).encode())
    if rng.random() < 0.03:
        return b"[" * 5000 + b"]" * 5000
    text = json.dumps(value(rng, given), ensure_ascii=False)
    return text.encode("utf-8", errors="surrogatepass")


def huge_json(rng):
    """The bytes of a JSON file that is nested, long or large past all use."""
    way = int(rng.integers(0, 5))
    if way == 0:
        depth = int(rng.choice([100, 900, 960, 100_000]))
        return b'{"made_from": {"settings": ' + b'{"a": ' * depth + b"1" + b"}" * depth + b"}}"
    if way == 1:
        return b'{"samples": [' + b"0, " * 3_000_000 + b"0]}"
    if way == 2:
        return b'{"accuracy": ' + b"9" * 1_000_000 + b"}"
    if way == 3:
        return b'{"made_from": {"settings": {' + b", ".join(
            b'"a%d": %d' % (n, n) for n in range(200_000)
        ) + b'}, "contents": {}}}'  # fmt: skip
    return b'{"a": "' + b"x" * (300 << 20) + b'"}'


def arrays(rng, given):
    """Named arrays, one of which is another."""
    given = {name: np.array(array) for name, array in given.items()}
    name = str(rng.choice(sorted(given)))
    array, way = given[name], rng.integers(0, 11)
    if way == 0:
        del given[name]
    elif way == 1:
        given[name + "x"] = array
    elif way == 2 and array.dtype.kind == "f" and array.size:
        array.flat[int(rng.integers(0, array.size))] = pick(rng, (math.nan, math.inf, 1e300, -1e9))
    elif way == 3:
        given[name] = np.resize(array, [int(n) for n in rng.integers(0, 9, rng.integers(0, 5))])
    elif way == 4:
        given[name] = array.astype(complex) + 1j if array.dtype.kind in "fi" else array
    elif way == 5:
        given[name] = np.full(array.shape, rng.choice(["x", "", "nan"]))
    elif way == 6 and array.dtype.kind in "fi" and array.size:
        array.flat[int(rng.integers(0, array.size))] = 99
    elif way == 7:
        given[name] = array[None]
    elif way == 8:
        given[name] = array[..., None] if array.ndim else array[None]
    elif way == 9:
        given[name] = array[:-1] if array.ndim and len(array) else np.zeros((0,))
    elif array.dtype.kind in "fi":
        kinds = ["f2", "f8", "i1", "u8", "i8", "?", ">f8", "M8[s]", "V8", "U1"]
        with np.errstate(all="ignore"):
            given[name] = array.astype(rng.choice(kinds))
    elif array.size:
        given[name] = np.resize(array.flat[0], array.shape)
    return given


def toml_text(rng, lines):
    """The bytes of a TOML file with something wrong in it."""
    way = rng.random()
    if way < 0.1:
        return some_bytes(rng, "\n".join(lines).encode())
    if way < 0.13:
        return b"a = " + b"[" * 5000 + b"]" * 5000
    if way < 0.16:
        return ("a" + ".a" * 5000 + " = 1").encode()
    lines = list(lines)
    for _ in range(int(rng.choice([1, 1, 2]))):
        index = int(rng.integers(0, len(lines)))
        name, equals, _ = lines[index].partition(" = ")
        if equals:
            lines[index] = f"{name} = {_toml(pick(rng, NUMBERS + OTHERS + TEXTS))}"
        elif rng.random() < 0.3:
            lines.insert(index, lines[int(rng.integers(0, len(lines)))])
    return "\n".join(lines).encode("utf-8", errors="surrogatepass")


def _toml(given):
    if given is None or isinstance(given, dict):
        return "{ a = 1 }"
    if isinstance(given, float) and not math.isfinite(given):
        return str(given)
    return json.dumps(given, ensure_ascii=False)


def pick(rng, values):
    """One of some values."""
    return values[int(rng.integers(0, len(values)))]


def _places(given):
    items = given.items() if isinstance(given, dict) else enumerate(given)
    for key, inner in list(items):
        yield given, key
        if isinstance(inner, (dict, list)):
            yield from _places(inner)
