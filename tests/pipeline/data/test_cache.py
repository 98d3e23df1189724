import json
import os

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.data import archive, cache
from pipeline.data import library as sources
from pipeline.data.events import TaxelMap
from pipeline.data.facts import facts_of
from tests.own_sensor import write_folder
from tests.pipeline.handmade import GOOD, assert_same, good_members, recordings
from tests.pipeline.handmade import archive as write_archive


@pytest.fixture
def own(tmp_path, monkeypatch):
    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_round_trip(own):
    table = TaxelMap(row=np.arange(100) // 10, column=np.arange(100) % 10)
    stored = recordings(GOOD, [], GOOD[1:3], labels=[3, 1, 4], taxels=table)
    assert cache.load("key") is None
    cache.store("key", stored)
    assert_same(cache.load("key"), stored)


def test_keys_tell_their_parts_apart():
    parts = [("a", 1), ("a", "1"), ("a1",), ("a", 1, False), ("a", 1, True)]
    assert len({cache.key_of(*p) for p in parts}) == len(parts)


@pytest.mark.parametrize("damage", ["cut", "flipped", "text", "other arrays", "counts", "pickle"])
def test_a_damaged_file_is_named_with_a_remedy(own, damage):
    cache.store("key", recordings(GOOD))
    (path,) = own.glob("recordings-*")
    content = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        content[content.index(recordings(GOOD).offsets.tobytes())] ^= 0xFF
        path.write_bytes(content)
    elif damage == "text":
        path.write_text("not an archive")
    elif damage == "other arrays":
        np.savez(path, x=np.zeros(3))
    else:
        with np.load(path) as file:
            arrays = dict(file)
        if damage == "counts":
            arrays["offsets"] = arrays["offsets"][:0]
        else:
            arrays["ids"] = np.array([{"a": 1}], dtype=object)
        np.savez(path, **arrays)
    with pytest.raises(UserError, match=f"{path.name}: "):
        cache.load("key")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("labels", np.array([-1, 4])),
        ("labels", np.array([3, 10])),
        ("labels", np.array([2.5, 4])),
        ("labels", np.array([3])),
        ("taxel", 100),
        ("taxel", -1),
        ("polarity", 7),
        ("polarity", 0),
        ("columns", 0),
        ("time_ns", -1),
        ("time_ns", 10**18),
        ("offsets", np.array([0, -1, 8])),
        ("offsets", np.array([0, 9, 8])),
        ("offsets", np.array([1, 4, 8])),
        ("offsets", np.array([0.0, 4, 8])),
        ("row", np.full(100, 10)),
        ("row", np.full(99, 1)),
        ("column", np.full(100, -1)),
        ("size", np.array([0, 10, 2])),
        ("size", np.array([10, 10])),
        ("duration_s", np.array(np.nan)),
        ("classes", np.array(["0"] * 10)),
        ("classes", np.arange(10)),
        ("writers", np.array([-2, 0])),
        ("ids", np.array(["a"])),
    ],
)
def test_values_that_no_import_gives_are_refused(own, name, value):
    cache.store("key", recordings(GOOD, GOOD, labels=[3, 4]))
    (path,) = own.glob("recordings-*")
    with np.load(path) as file:
        arrays = dict(file)
    assert arrays["offsets"].tolist() == [0, 4, 8]
    if np.ndim(value) == 0 and name not in ("duration_s",):  # of one event
        column = arrays[name].astype(np.int64)
        column[2] = value
        value = column
    np.savez(path, **{**arrays, name: value})
    with pytest.raises(UserError, match=f"{path.name}: "):
        cache.load("key")


def test_events_out_of_order_are_refused(own):
    cache.store("key", recordings(GOOD, GOOD, labels=[3, 4]))
    (path,) = own.glob("recordings-*")
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{**arrays, "time_ns": arrays["time_ns"][[1, 0, 2, 3, 4, 5, 6, 7]]})
    with pytest.raises(UserError, match="time_ns"):
        cache.load("key")


def test_the_second_start_reads_the_cache(own, tmp_path, monkeypatch):
    write_archive(tmp_path / "st.zip", good_members(2))
    first = sources.load_recordings(str(tmp_path / "st.zip"), jobs=1)

    def no_reading(*args, **kwargs):
        raise AssertionError("the archive was read or hashed again")

    monkeypatch.setattr(archive, "read_source", no_reading)
    monkeypatch.setattr(archive, "content_hash", no_reading)
    assert_same(sources.load_recordings(str(tmp_path / "st.zip"), jobs=1), first)


def test_other_content_under_the_same_name_is_read_anew(own, tmp_path):
    path = tmp_path / "st.zip"
    write_archive(path, good_members(1))
    assert len(sources.load_recordings(str(path), jobs=1)) == 10
    write_archive(path, good_members(2))
    assert len(sources.load_recordings(str(path), jobs=1)) == 20


def test_an_import_with_files_left_out_does_not_pass_for_a_clean_one(own, tmp_path):
    path = tmp_path / "st.zip"
    write_archive(path, {**good_members(), "3/bad.mat": b"bad"})
    for _ in range(2):  # read, then from the cache
        lines = []
        read = sources.load_recordings(str(path), skip_bad=True, jobs=1, warn=lines.append)
        assert len(read) == 10
        assert len(lines) == 1
        assert "3/bad.mat" in lines[0]
        assert facts_of(read)["files_left_out"] == 1
    with pytest.raises(UserError, match=r"3/bad\.mat"):
        sources.load_recordings(str(path), jobs=1)


def test_an_empty_class_is_refused_although_the_rest_is_in_the_cache(own, tmp_path):
    write_folder(tmp_path / "own", per_class=2)
    assert len(sources.load_recordings(str(tmp_path / "own"), jobs=1)) == 8
    (tmp_path / "own" / "next week").mkdir()
    with pytest.raises(UserError, match="next week"):
        sources.load_recordings(str(tmp_path / "own"), jobs=1)


@pytest.mark.parametrize("value", [5, None, ["a"], "../../etc", "A" * 64])
def test_a_noted_hash_that_is_none_is_forgotten(own, value):
    cache.remember("f" * 64, "0" * 64)
    assert cache.recall("f" * 64) == "0" * 64
    (path,) = cache.folder().glob("source-*.json")
    path.write_text(json.dumps({"sha256": value}))
    assert cache.recall("f" * 64) is None


def test_simulated_recordings_are_cached_by_seed_and_number(own, monkeypatch):
    first = sources.load_recordings(samples_per_digit=2, simulation_seed=1, jobs=1)
    other = sources.load_recordings(samples_per_digit=2, simulation_seed=2, jobs=1)
    assert first.source.sha256 != other.source.sha256
    monkeypatch.setattr(sources, "simulate", None)  # calling it would raise TypeError
    again = sources.load_recordings(samples_per_digit=2, simulation_seed=1, jobs=1)
    assert_same(again, first)
    assert again.source.simulated


def test_an_unwritable_cache_is_one_clear_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(UserError, match="file/cache"):
        sources.load_recordings(samples_per_digit=1, jobs=1)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("3/x.mat", os.mkfifo),
        *((name, lambda path: path.symlink_to("nowhere")) for name in ("3/x", "11")),
    ],
)
def test_a_link_to_nothing_beside_recordings_in_the_cache_is_said(own, tmp_path, make, name):
    folder = tmp_path / "data"
    for member, content in good_members(2, root="").items():
        (folder / member).parent.mkdir(parents=True, exist_ok=True)
        (folder / member).write_bytes(content)
    assert len(sources.load_recordings(str(folder), jobs=1)) == 20
    make(folder / name)
    with pytest.raises(UserError, match=f"1 of 21 .*{name}"):
        sources.load_recordings(str(folder), jobs=1)
    assert len(sources.load_recordings(str(folder), skip_bad=True, jobs=1)) == 20
