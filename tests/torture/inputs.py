"""Inputs of every kind, whole and damaged: each case is a folder and a command on it."""

import csv
import hashlib
import io
import json
import os
import shutil
import struct
import zipfile
import zlib
from dataclasses import dataclass, replace

import h5py
import numpy as np
import scipy.io

from deploy import limits
from deploy.check.bundle import CheckSet, write_bundle
from deploy.files import read_arrays, read_json

from ..deploy.fast_networks import random_spec
from . import damage
from .records import record

SHARES = {
    "mat5": 0.21, "mat73": 0.095, "zip": 0.09, "bundle": 0.18, "settings": 0.1, "result": 0.05,
    "run": 0.03, "links": 0.03, "network": 0.05, "cache": 0.03, "pipe": 0.03, "source": 0.005,
    "record": 0.07, "person": 0.03,
}  # fmt: skip
"""Of each kind in a campaign."""


@dataclass(frozen=True)
class Base:
    """What is damaged.

    Attributes
    ----------
    run : Path
        A finished run of tiny networks, its cache in ``cache`` beside it.
    """

    run: object


def plan(count):
    """The kind of each case of a campaign of ``count``: many of each, in a fixed order."""
    kinds = list(SHARES)
    wanted = {kind: max(1, round(share * count)) for kind, share in SHARES.items()}
    rounds = [(i / wanted[k], kinds.index(k), k) for k in kinds for i in range(wanted[k])]
    return [kind for *_, kind in sorted(rounds)][:count]


def make(kind, rng, folder, base):
    """Write a case's files into a folder and give its command's arguments."""
    return KINDS[kind](rng, folder, base)


def spiketrain(n, rng):
    """Events on random taxels, 1 ms apart."""
    array = np.zeros((101, n))
    array[rng.integers(0, 100, n), np.arange(n)] = rng.choice([-1, 1], n)
    array[100] = 0.1 + 0.001 * np.arange(n)
    return array


def odd_variables(rng):
    """Whole files that say something else than a recording."""
    good = spiketrain(int(rng.integers(1, 40)), rng)
    way = int(rng.integers(0, 14))
    if way == 0:
        good[100, -1] = rng.choice([np.nan, np.inf, -1, 1e300, 1e9])
    elif way == 1:
        good = good[:-1]
    elif way == 2:
        good = good[:, :0]
    elif way == 3:
        good[int(rng.integers(0, 100)), 0] = rng.choice([2, 0.5, np.nan, 1e300])
    elif way == 4:
        good = good + 1j
    elif way == 5:
        good = "text"
    elif way == 6:
        good = {"a": good}
    elif way == 7:
        good = np.array([good, "x"], dtype=object)
    elif way == 8:
        good = good.astype(rng.choice(["i1", "u1", "i8", "u8", "f4", "?"]))
    elif way == 9:
        good = scipy.sparse.csc_matrix(good)
    elif way == 10:
        good = good[:, ::-1]
    elif way == 11:
        good = good[..., None]
    more = {}
    if rng.random() < 0.3:
        more["writer"] = [3.0, -5.0, "me", np.nan, 1e300, {"a": 1}, [1, 2], -1][rng.integers(0, 8)]
    if rng.random() < 0.2:
        more["simulated"] = [1.0, "yes", np.nan, [0, 1]][rng.integers(0, 4)]
    return {"spiketrain": good, **more}


def mat5(rng, folder, base):
    """A MATLAB 5 file: damaged bytes, damaged inside the compression, bombs, other contents."""
    way, path = rng.random(), folder / "a.mat"
    if way < 0.2:
        variables = odd_variables(rng)
    else:
        variables = {"spiketrain": spiketrain(int(rng.integers(1, 60)), rng)}
    compressed = bool(rng.random() < 0.5)
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, do_compression=compressed)
    content = buffer.getvalue()
    if 0.2 <= way < 0.6:
        content = content[:128] + _inside(rng, content[128:], compressed)
    elif 0.6 <= way < 0.93:
        content = damage.some_bytes(rng, content)
    elif way >= 0.93:
        content = _mat5_bomb(rng)
    path.write_bytes(content)
    return ["data", "inspect", path]


def _inside(rng, body, compressed):
    """Damage the elements under the compression, tags above all, and close it again."""
    if not compressed:
        return _tags(rng, body)
    length = int.from_bytes(body[4:8], "little")
    inner = _tags(rng, zlib.decompress(body[8 : 8 + length]))
    packed = zlib.compress(inner)
    return struct.pack("<II", 15, len(packed)) + packed


def _tags(rng, body):
    """Another type or size in one of the first elements' tags."""
    if rng.random() < 0.3:
        return damage.some_bytes(rng, body)
    body = bytearray(body)
    place = int(rng.choice([0, 8, 16, 24, 28, 32, 36, 40, 48, 56, 60, 64, 68]))
    new = int(rng.choice([*range(0, 24), 100, 2**16, 10**6, 2**31 - 1, 2**31, 2**32 - 1]))
    body[place : place + 4] = struct.pack("<I", new)
    return bytes(body)


def _mat5_bomb(rng):
    """Megabytes that become gigabytes: a matrix of zeros of far more columns than a recording."""
    columns = int(rng.choice([10**5, 10**6, 4 * 10**6]))
    size = 101 * columns * 8
    head = struct.pack("<IIIIII", 6, 8, 6, 0, 5, 8) + struct.pack("<ii", 101, columns)
    head += struct.pack("<II", 1, 10) + b"spiketrain".ljust(16, b"\0") + struct.pack("<II", 9, size)
    packer, parts = zlib.compressobj(9), []
    parts.append(packer.compress(struct.pack("<II", 14, len(head) + size) + head))
    block = bytes(1 << 20)
    for _ in range(-(-size // len(block))):
        parts.append(packer.compress(block))
    packed = b"".join([*parts, packer.flush()])
    text = b"MATLAB 5.0 MAT-file, a bomb".ljust(116) + bytes(8) + struct.pack("<HH", 0x0100, 0x4D49)
    return text + struct.pack("<II", 15, len(packed)) + packed


def mat73(rng, folder, base):
    """A MATLAB 7.3 file: the same in HDF5."""
    way, path, buffer = rng.random(), folder / "a.mat", io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=512) as file:
        if way < 0.15:
            columns = int(rng.choice([10**6, 10**8, 10**12]))
            file.create_dataset("spiketrain", (columns, 101), "f8", chunks=(100, 101), fillvalue=0)
        elif way < 0.25:
            file.create_group("spiketrain")
            file["writer"] = h5py.SoftLink("/nowhere")
        elif way < 0.3:
            file["spiketrain"] = h5py.ExternalLink("/etc/hostname", "/x")
        else:
            for name, variable in odd_variables(rng).items():
                if not isinstance(variable, (dict, list)) and not scipy.sparse.issparse(variable):
                    array = np.asarray(variable)
                    if array.dtype.kind == "U":
                        array = np.array([ord(c) for c in str(array)], np.uint16)
                    if array.dtype.kind == "O":
                        array = np.zeros(3)
                    many = array.ndim and rng.random() < 0.3 and array.size
                    file.create_dataset(
                        name, data=array.T, **({"compression": "gzip"} if many else {})
                    )
                elif name != "spiketrain":
                    file.create_group(name)
    content = bytearray(buffer.getvalue())
    content[:512] = b"MATLAB 7.3 MAT-file, made by hand".ljust(512)
    content = bytes(content)
    if way > 0.5:
        content = content[:512] + damage.some_bytes(rng, content[512:])
    path.write_bytes(content)
    return ["data", "inspect", path]


def zipped(rng, folder, base):
    """A zip of recordings: damaged, odd members, odd compression, bombs, many members."""
    path, way = folder / "st.zip", int(rng.integers(0, 12))
    members = {}
    for digit in range(10):
        buffer = io.BytesIO()
        scipy.io.savemat(buffer, {"spiketrain": spiketrain(3 + digit, rng)})
        members[f"data_submission/{digit}/a.mat"] = buffer.getvalue()
    names = list(members)
    kinds = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    kind = kinds[int(rng.integers(0, 4))]
    if way == 0:
        members["../../evil/3/x.mat"] = b"x"
    elif way == 1:
        members["/3/x.mat"] = members.pop(names[0])
    elif way == 2:
        for i in range(int(rng.choice([100, 3000]))):
            members[f"3/{i}-{'n' * 80}.mat"] = b"x"
    elif way == 3:
        members[names[int(rng.integers(0, 10))]] = damage.some_bytes(rng, members[names[0]])
    elif way == 4:
        members["LUT.mat"] = damage.some_bytes(rng, members[names[0]])
    elif way == 5:
        members = {str(rng.choice(["a", "3/a.txt", "x/a.mat"])): b"x"}
    elif way == 6:
        members["9/\udcffb.mat".encode("utf-8", "surrogateescape").decode("cp437")] = b"x"
    with zipfile.ZipFile(path, "w", kind) as file:
        for name, content in members.items():
            file.writestr(name, content)
        if way == 7:
            with file.open("3/bomb.mat", "w", force_zip64=True) as member:
                for _ in range(int(rng.choice([40, 300]))):
                    member.write(bytes(1 << 20))
    if way >= 8:
        path.write_bytes(_zip_fields(rng, path.read_bytes()))
    more = ["--skip-bad"] if rng.random() < 0.3 else []
    return ["data", "import", path, "--jobs", 1, *more]


def _zip_fields(rng, content):
    """Damage a zip, its directory above all."""
    content = bytearray(content)
    place = content.find(b"PK\x01\x02")
    if rng.random() < 0.3 or place < 0:
        return damage.some_bytes(rng, content)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(place, len(content)))
        content[at] = int(rng.integers(0, 256))
    return bytes(content)


def bundle(rng, folder, base):
    """A bundle with right hashes and something wrong in it."""
    path = folder / "bundle"
    shutil.copytree(base.run / "bundle", path)
    way = rng.random()
    if way < 0.55:
        description = read_json(path / "network.json", "")
        (path / "network.json").write_bytes(damage.json_text(rng, description))
    elif way < 0.85:
        name = str(rng.choice(["weights.npz", "checks.npz", "checks.npz"]))
        given = damage.arrays(rng, read_arrays(path / name, ""))
        with zipfile.ZipFile(path / name, "w") as archive:
            for key, array in given.items():
                with archive.open(key + ".npy", "w") as stream:
                    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=True)
    elif way < 0.95:
        name = str(rng.choice(["weights.npz", "checks.npz", "network.json", "deploy.pyz"]))
        (path / name).write_bytes(damage.some_bytes(rng, (path / name).read_bytes()))
    rehash(path)
    if way >= 0.95:
        manifest = read_json(path / "MANIFEST.json", "")
        (path / "MANIFEST.json").write_bytes(damage.json_text(rng, manifest))
    verbs = [
        ["check", "run", path, "--target", "fast", "--out", folder / "fast.json"],
        ["deploy", "plan", path],
        ["deploy", "export", path, "--format", "lava", "--out", folder / "lava.npz"],
        *(["check", "run", path, "--target", target, "--out", folder / f"{target}.json"]
          for target in ("nengo", "simreal", "emulator")),
    ]  # fmt: skip
    return verbs[int(rng.choice([0, 0, 0, 0, 1, 1, 2, 3, 4, 5]))]


def network(rng, folder, base):
    """A bundle of any network that can be described, of any scale, on every target."""
    spec = random_spec(int(rng.integers(0, 10**6)))
    layers = list(spec.layers)
    if rng.random() < 0.6:
        index, factor = int(rng.integers(0, len(layers))), 10.0 ** rng.uniform(-30, 8)
        limit = limits.MAGNITUDE
        layers[index] = replace(
            layers[index],
            weights=np.clip(layers[index].weights * factor, -limit, limit),
            bias=np.clip(layers[index].bias * 10.0 ** rng.uniform(-3, 3), -limit, limit),
        )
    stimulus = spec.stimulus
    if hasattr(stimulus, "max_rate") and rng.random() < 0.3:
        stimulus = replace(stimulus, max_rate=float(10.0 ** rng.uniform(-3, 3)))
    spec = replace(spec, layers=tuple(layers), stimulus=stimulus)
    shape = spec.stimulus.sample_shape(spec.input_shape, spec.presentation.steps)
    inputs = rng.random((3, *shape)) * (rng.random((3, *shape)) < 0.7)
    if not spec.stimulus.static:
        inputs = (inputs > 0.6).astype(np.uint8)
    checks = CheckSet(inputs, rng.integers(0, spec.layers[-1].size, 3), ("a", "b", "c"), 0)
    path = folder / "bundle"
    write_bundle(path, spec, checks)
    verbs = [["deploy", "plan", path]]
    verbs += [["check", "run", path, "--target", target, "--out", folder / f"{target}.json"]
              for target in ("nengo", "simreal", "emulator", "fast")]  # fmt: skip
    return verbs[int(rng.integers(0, len(verbs)))]


def rehash(path):
    """Write the hashes that a bundle's files have now into its manifest."""
    manifest = read_json(path / "MANIFEST.json", "")
    for name in manifest["files"]:
        manifest["files"][name] = hashlib.sha256((path / name).read_bytes()).hexdigest()
    (path / "MANIFEST.json").write_text(json.dumps(manifest))


def settings(rng, folder, base):
    """Settings in a file or on the command line; no recordings follow, so nothing is trained."""
    path = folder / "mine.toml"
    lines = (base.run / "experiment.toml").read_text().splitlines()
    nowhere = ["--data", folder / "nowhere.zip"]
    if rng.random() < 0.7:
        path.write_bytes(damage.toml_text(rng, lines))
        return ["train", folder / "run", "--settings", path, *nowhere]
    names, section = [], ""
    for line in lines:
        if line.startswith("["):
            section = line.strip("[]") + "."
        elif " = " in line:
            names.append(section + line.partition(" = ")[0])
    name = str(rng.choice(names))
    values = damage.NUMBERS + tuple(t for t in damage.TEXTS if "\ud800" not in t)
    given = str(values[int(rng.integers(0, len(values)))]).replace("\0", "")
    return ["ladder", folder / "run", "--set", f"{name}={given}", *nowhere]


def result(rng, folder, base):
    """A check result, compared with a whole one or used for an estimate."""
    given = read_json(base.run / "checks" / "emulator.json", "")
    path = folder / "a.json"
    path.write_bytes(damage.json_text(rng, given))
    if rng.random() < 0.6:
        pair = [path, base.run / "checks" / "nengo.json"]
        return ["check", "compare", *(pair if rng.random() < 0.5 else pair[::-1])]
    return ["deploy", "energy", base.run / "bundle", path]


def run_folder(rng, folder, base):
    """A finished run with something wrong in it, and its report."""
    run = folder / "run"
    shutil.copytree(base.run, run)
    (folder / "cache").symlink_to(base.run.parent / "cache")
    names = [
        "snn/history.csv", "cnn/history.csv", "snn/metrics.json", "cnn/metrics.json",
        "checks/emulator.json", "checks/cnn.json", "checks/trained.json", "ladder.json",
        "dataset.json",
    ]  # fmt: skip
    path = run / str(rng.choice([name for name in names if (run / name).exists()]))
    if path.suffix == ".json":
        path.write_bytes(damage.json_text(rng, read_json(path, "")))
    else:
        path.write_bytes(_history(rng, path))
    return ["report", run]


def _history(rng, path):
    if rng.random() < 0.5:
        return damage.some_bytes(rng, path.read_bytes())
    rows = list(csv.reader(io.StringIO(path.read_text())))
    row = rows[int(rng.integers(0, len(rows)))]
    row[int(rng.integers(0, len(row)))] = str(rng.choice(["", "x", "nan", "inf", "1e999", "\0"]))
    if rng.random() < 0.3:
        row.append("1")
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


def cache(rng, folder, base):
    """Recordings in the cache, damaged or with other values, and a command that uses them."""
    run = folder / "run"
    shutil.copytree(base.run, run)
    shutil.copytree(base.run.parent / "cache", folder / "cache")
    paths = sorted((folder / "cache").glob("recordings-*.npz"))
    path = paths[int(rng.integers(0, len(paths)))]
    if rng.random() < 0.2:
        path.write_bytes(damage.some_bytes(rng, path.read_bytes()))
    else:
        given = damage.arrays(rng, read_arrays(path, ""))
        with zipfile.ZipFile(path, "w") as archive:
            for key, array in given.items():
                with archive.open(key + ".npy", "w") as stream:
                    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=True)
    return ["report", run]


def source(rng, folder, base):
    """A zip of recordings each of which is within all limits, and all together may not be."""
    path, events = folder / "st.zip", int(rng.choice([10, 10**5, 10**6, 5 * 10**6]))
    one = io.BytesIO()
    zeros = np.zeros(events, np.uint8)
    np.savez_compressed(one, x=zeros, y=zeros, t=np.linspace(0, 2, events, dtype=np.float32),
                        p=zeros + np.int8(1))  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        for digit in range(10):
            for index in range(int(rng.choice([2, 4, 20]))):
                archive.writestr(f"{digit}/{index}.npz", one.getvalue())
    return ["data", "import", path, "--jobs", 1]


def pipe(rng, folder, base):
    """A pipe, a link to nothing, a device or a sparse file of a terabyte where a file belongs."""
    path = folder / str(rng.choice(["a.mat", "a.npz", "a.zip", "a.json", "a.keras", "a.toml"]))
    way = int(rng.integers(0, 5))
    if way == 0:
        os.mkfifo(path)
    elif way < 3:
        path.symlink_to(["nowhere", "/dev/zero"][way - 1])
    elif way == 3:
        with open(path, "wb") as file:
            file.seek(1 << 40)
            file.write(base.run.with_name("st.zip").read_bytes())
    else:
        path.mkdir()
    data = folder / "data" / "3"
    data.mkdir(parents=True)
    (data / "a.mat").symlink_to(path)
    verbs = [
        ["data", "inspect", path], ["data", "import", path], ["data", "import", folder / "data"],
        ["check", "compare", path, path], ["train", folder / "run", "--settings", path],
        ["convert", folder / "run", "--model", path],
        ["deploy", "energy", base.run / "bundle", path],
    ]  # fmt: skip
    return verbs[int(rng.integers(0, len(verbs)))]


def person(rng, folder, base):
    """Recordings of another person, or the bundle, with something wrong, and what reads both."""
    path, damaged = folder / "st.zip", rng.random() < 0.6
    with zipfile.ZipFile(path, "w") as archive:
        for digit in range(10):
            for index in range(2):
                buffer = io.BytesIO()
                odd = damaged and rng.random() < 0.08
                given = odd_variables(rng) if odd else {"spiketrain": spiketrain(20 + digit, rng)}
                given.setdefault("writer", float(rng.choice([7, 7, 7, 8])))
                scipy.io.savemat(buffer, given)
                archive.writestr(f"{digit}/{index}.mat", buffer.getvalue())
    if damaged:
        shutil.copytree(base.run / "bundle", folder / "bundle")
    else:
        bundle(rng, folder, base)
    (folder / "cache").symlink_to(base.run.parent / "cache")
    verbs = [
        ["adapt", folder / "bundle", "--data", path, "--writer", 7, "--jobs", 1],
        ["adapt", folder / "bundle", "--data", path, "--jobs", 1],
        ["check", "run", folder / "bundle", "--target", "fast", "--data", path, "--jobs", 1],
        ["check", "run", folder / "bundle", "--target", "nengo", "--data", path, "--samples", 2,
         "--jobs", 1],
        ["animate", _with_bundle(folder, base), "--out", folder / "a.gif", "--jobs", 1],
    ]  # fmt: skip
    return verbs[int(rng.choice([0, 0, 1, 2, 2, 3, 4]))]


def _with_bundle(folder, base):
    """A run that has the folder's bundle."""
    run = folder / "run"
    shutil.copytree(base.run, run)
    shutil.rmtree(run / "bundle")
    shutil.copytree(folder / "bundle", run / "bundle")
    return run


ELSEWHERE = b"somebody else's"
"""Content of a file that no command may change."""


def links(rng, folder, base):
    """A run in which something that is written is a link to a file or folder elsewhere."""
    run, precious = folder / "run", folder / "elsewhere" / "precious"
    shutil.copytree(base.run, run)
    (folder / "cache").symlink_to(base.run.parent / "cache")
    precious.parent.mkdir()
    precious.write_bytes(ELSEWHERE)
    made = sorted(path for path in run.rglob("*") if path.name != "experiment.toml")
    saved = [run / "checks" / f".{target}.json.partial" for target in ("fast", "nengo")]
    path = [run / ".lock", *saved, *made][int(rng.integers(0, 3 + len(made)))]
    if rng.random() < 0.5:
        path = [run / ".lock", *saved][int(rng.integers(0, 3))]
    target = precious.parent if path.is_dir() else precious
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    if target.is_file() and rng.random() < 0.3:
        os.link(target, path)
    else:
        path.symlink_to(target)
    verbs = [
        ["check", "run", run / "bundle", "--target", "fast"],
        ["check", "run", run / "bundle", "--target", "nengo"],
        ["ladder", run, "--jobs", 1],
        ["report", run],
        ["deploy", "export", run / "bundle", "--format", "lava", "--out", path],
    ]
    return verbs[int(rng.integers(0, len(verbs)))]


def harmed(folder):
    """What a command did to the file elsewhere that it must leave alone, or None."""
    precious = folder / "elsewhere"
    if not precious.is_dir():
        return None
    there = {path.name: path.read_bytes() for path in precious.iterdir()}
    return None if there == {"precious": ELSEWHERE} else f"wrote through a link: {there}"


KINDS = {
    "mat5": mat5, "mat73": mat73, "zip": zipped, "bundle": bundle, "settings": settings,
    "result": result, "run": run_folder, "links": links,
    "network": network, "cache": cache, "pipe": pipe, "source": source,
    "record": record, "person": person,
}  # fmt: skip
