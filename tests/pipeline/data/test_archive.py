import os
import re
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from joblib.externals.loky.process_executor import TerminatedWorkerError

from deploy.errors import UserError
from pipeline.data.archive import (
    _read_chunks,
    _read_members,
    content_hash,
    fingerprint,
    left_out_lines,
    list_source,
    read_file,
    read_source,
    write_zip,
)
from pipeline.data.budget import Spent
from pipeline.data.events import TaxelMap
from pipeline.data.matfile import lookup_table_bytes
from pipeline.data.sensors import class_order
from pipeline.skin.simulate import simulate
from tests.command import missing
from tests.pipeline import deadly
from tests.pipeline.handmade import (
    archive,
    assert_same,
    encrypt,
    good_members,
    mat5,
    mat73,
    spiketrain,
)

BAD_MEMBERS = {
    "data_submission/3/text.mat": (b"not a mat file", "MAT"),
    "data_submission/3/nothing.mat": (b"", "empty"),
    "data_submission/4/other.mat": (mat5(x=1.0), "'spiketrain'"),
    "data_submission/5/short.mat": (mat5(spiketrain=spiketrain()[:50]), " 50 "),
    "data_submission/6/ms.mat": (
        mat73(spiketrain=np.vstack([spiketrain()[:-1], 1000 * spiketrain()[-1:]])),
        "milliseconds",
    ),
    "data_submission/somewhere.mat": (mat5(x=1.0), "0 to 9"),
    "data_submission/12/two_digits.mat": (mat5(x=1.0), "0 to 9"),
    "data_submission/../../8/leaves.mat": (mat5(x=1.0), "path"),
    "/8/absolute.mat": (mat5(x=1.0), "path"),
}


def test_a_zip_in_the_published_layout(tmp_path):
    path = tmp_path / "st.zip"
    archive(path, good_members(3))
    read = read_source(path, jobs=1)
    assert len(read) == 30
    assert read.labels.tolist() == sorted(list(range(10)) * 3)
    assert read.ids[:4] == ("0/000", "0/001", "0/002", "1/000")
    assert not read.source.simulated
    assert [len(read[i]) for i in range(4)] == [1, 2, 3, 2]


@pytest.mark.parametrize("root", ["", "a/b/c/", "STMNIST dataset NUS/data_submission/"])
def test_digit_folders_at_any_depth_in_zip_and_folder(tmp_path, root):
    path = tmp_path / "st.zip"
    archive(path, {**good_members(root=root), "readme.txt": "x", "__MACOSX/3/._a.mat": "x"})
    folder = tmp_path / "unpacked"
    with zipfile.ZipFile(path) as file:
        file.extractall(folder)
    from_zip, from_folder = read_source(path, jobs=1), read_source(folder, jobs=1)
    assert len(from_zip) == 10
    assert_same(from_zip, from_folder, source=False)


def test_a_folder_of_other_files_beside_the_digits(tmp_path):
    archive(tmp_path / "st.zip", {**good_members(), "data_submission/code/plot.m": "x"})
    assert len(read_source(tmp_path / "st.zip", jobs=1)) == 10
    archive(tmp_path / "st.zip", {**good_members(), "data_submission/code/": ""})
    with pytest.raises(UserError, match=r"1 of 11 .*code"):
        read_source(tmp_path / "st.zip", jobs=1)


@pytest.mark.parametrize("where", ["LUT.mat", "data_submission/LUT.mat", "x/y/lut.MAT"])
def test_the_lookup_table_is_taken_from_wherever_it_is(tmp_path, where):
    table = TaxelMap(row=np.arange(100) // 10, column=np.arange(100) % 10)
    archive(tmp_path / "st.zip", {**good_members(), where: lookup_table_bytes(table)})
    read = read_source(tmp_path / "st.zip", jobs=1)
    np.testing.assert_array_equal(read.taxels.row, table.row)
    assert len(read) == 10


def test_lookup_tables_that_differ_are_refused(tmp_path):
    tables = {name: lookup_table_bytes(TaxelMap.grid(10, 10)) for name in ("LUT.mat", "a/LUT.mat")}
    archive(tmp_path / "st.zip", {**good_members(), **tables})
    assert len(read_source(tmp_path / "st.zip", jobs=1)) == 10
    other = TaxelMap(row=np.arange(100) // 10, column=np.arange(100) % 10)
    tables["a/LUT.mat"] = lookup_table_bytes(other)
    archive(tmp_path / "st.zip", {**good_members(), **tables})
    with pytest.raises(UserError, match=r"1 of 11 .* a/LUT\.mat .* LUT\.mat"):
        read_source(tmp_path / "st.zip", jobs=1)


def test_without_a_lookup_table_the_documented_reading_holds(tmp_path):
    archive(tmp_path / "st.zip", good_members())
    taxels = read_source(tmp_path / "st.zip", jobs=1).taxels
    assert (taxels.row[37], taxels.column[37]) == (7, 3)


def test_all_bad_files_are_listed_with_their_reasons(tmp_path):
    members = {**good_members(), **{name: bad[0] for name, bad in BAD_MEMBERS.items()}}
    archive(tmp_path / "st.zip", members)
    with pytest.raises(UserError) as caught:
        read_source(tmp_path / "st.zip", jobs=1)
    message = str(caught.value)
    for name, (_, reason) in BAD_MEMBERS.items():
        assert any(name in line and reason in line for line in caught.value.lines)
    assert missing(message, f"{len(BAD_MEMBERS)} of {len(members)} ", "--skip-bad") == []


def test_the_others_are_read_when_told_to(tmp_path):
    good = good_members()
    archive(tmp_path / "st.zip", {**good, **{name: bad[0] for name, bad in BAD_MEMBERS.items()}})
    archive(tmp_path / "good.zip", good)
    read = read_source(tmp_path / "st.zip", jobs=1, skip_bad=True)
    lines = read.source.left_out
    assert_same(read, read_source(tmp_path / "good.zip", jobs=1), source=False)
    assert len(lines) == len(BAD_MEMBERS)
    for name, (_, reason) in BAD_MEMBERS.items():
        assert sum(name in line and reason in line for line in lines) == 1


def test_a_bad_lookup_table_is_named(tmp_path):
    archive(tmp_path / "st.zip", {**good_members(), "LUT.mat": mat5(LUT=np.ones((100, 2)))})
    with pytest.raises(UserError, match=r"LUT\.mat X and Y .* 100 "):
        read_source(tmp_path / "st.zip", jobs=1)
    read = read_source(tmp_path / "st.zip", 1, skip_bad=True)
    assert len(read) == 10
    assert "LUT.mat" in read.source.left_out[0]


def test_an_encrypted_member(tmp_path):
    path = tmp_path / "st.zip"
    archive(path, good_members())
    encrypt(path, "data_submission/4/000.mat")
    with pytest.raises(UserError, match=r"1 of 10 .*4/000\.mat .*encrypted"):
        read_source(path, jobs=1)
    assert len(read_source(path, jobs=1, skip_bad=True)) == 9


def test_a_member_twice(tmp_path):
    path = tmp_path / "st.zip"
    archive(path, good_members())
    with zipfile.ZipFile(path, "a") as file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr("data_submission/4/000.mat", mat5(spiketrain=spiketrain()))
    with pytest.raises(UserError, match=r"1 of 11 .*4/000\.mat .*twice"):
        read_source(path, jobs=1)


def test_a_damaged_member_is_named(tmp_path):
    path = tmp_path / "st.zip"
    archive(path, good_members())
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as file:
        start = file.getinfo("data_submission/7/000.mat").header_offset
    content[start + 400] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"1 of 10 .*7/000\.mat .*CRC"):
        read_source(path, jobs=1)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_zip(tmp_path, kept):
    path = tmp_path / "st.zip"
    archive(path, good_members())
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(UserError, match=r"st\.zip: .*\bzip\b"):
        read_source(path, jobs=1)


def test_a_zip_with_a_damaged_directory_is_a_reason_not_a_crash(tmp_path):
    path = tmp_path / "st.zip"
    archive(path, {"3/é.mat": mat5(spiketrain=spiketrain())})
    content = path.read_bytes()
    start = content.index(b"PK\x01\x02")
    for position in range(start, len(content)):
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        try:
            read_source(path, jobs=1, skip_bad=True)
        except UserError as error:
            assert "st.zip" in str(error)  # noqa: PT017 - any outcome but another exception


def test_nothing_there_and_nothing_in_it(tmp_path):
    (tmp_path / "folder").mkdir()
    archive(tmp_path / "empty.zip", {})
    archive(tmp_path / "bad.zip", {"3/a.mat": b"x"})
    for name in ("nowhere.zip", "folder", "empty.zip", "bad.zip"):
        with pytest.raises(UserError, match=f"^{tmp_path / name}: "):
            read_source(tmp_path / name, jobs=1, skip_bad=True)


def test_the_number_of_processes_changes_nothing(tmp_path):
    archive(tmp_path / "st.zip", good_members(8))
    one = read_source(tmp_path / "st.zip", jobs=1)
    assert_same(one, read_source(tmp_path / "st.zip", jobs=2))


def test_simulated_recordings_come_back_identically(tmp_path):
    recordings = simulate(seed=3, samples_per_digit=[3] * 10, jobs=1)
    turned = TaxelMap(row=np.arange(100) // 10, column=np.arange(100) % 10)
    recordings = replace(recordings, taxels=turned)
    write_zip(tmp_path / "st.zip", recordings)
    read = read_source(tmp_path / "st.zip", jobs=1)
    assert_same(read, recordings, source=False)
    assert read.source.simulated
    assert len(set(read.writers.tolist())) > 1
    assert (read.labels == recordings.labels).all()


def test_the_same_recordings_make_the_same_bytes(tmp_path):
    recordings = simulate(seed=3, samples_per_digit=[1] * 10, jobs=1)
    write_zip(tmp_path / "a.zip", recordings)
    write_zip(tmp_path / "b.zip", recordings)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    assert content_hash(tmp_path / "a.zip") == content_hash(tmp_path / "b.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as file:
        assert {member.date_time for member in file.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        (mat, *_) = (name for name in file.namelist() if name.endswith(".mat"))
        assert not re.search(rb"\d{4}", file.read(mat)[:116])  # no year


def test_the_hash_of_a_folder_follows_its_content(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name / "3").mkdir(parents=True)
        (tmp_path / name / "3" / "x.mat").write_bytes(b"one")
    assert content_hash(tmp_path / "a") == content_hash(tmp_path / "b")
    before = fingerprint(tmp_path / "a")
    (tmp_path / "a" / "3" / "x.mat").write_bytes(b"other")
    assert content_hash(tmp_path / "a") != content_hash(tmp_path / "b")
    assert fingerprint(tmp_path / "a") != before


@pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_read_and_their_damage_is_a_reason(tmp_path, kind):
    path = tmp_path / "st.zip"
    with zipfile.ZipFile(path, "w", kind) as file:
        for name, content in good_members().items():
            file.writestr(name, content)
    assert len(read_source(path, jobs=1)) == 10
    content = bytearray(path.read_bytes())
    content[90] ^= 0xFF  # in the first member
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"1 of 10 .*0/000\.mat "):
        read_source(path, jobs=1)


def test_a_member_that_says_it_is_huge_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.data.archive.LARGEST", 10_000)
    path = tmp_path / "st.zip"
    archive(path, {**good_members(), "3/bomb.mat": bytes(10_001)})
    with pytest.raises(UserError, match=r"3/bomb\.mat .* 10001 "):
        read_source(path, jobs=1)


def test_files_refused_for_one_reason_are_one_line(tmp_path):
    path = tmp_path / "st.zip"
    bad = {f"3/{'n' * 500}{i:03d}.mat": b"x" for i in range(300)}
    archive(path, {**good_members(), **bad})
    with pytest.raises(UserError, match=r"300 of 310 .*, 297 more\)") as error:
        read_source(path, jobs=1)
    assert len(error.value.lines[0]) < 1000
    read = read_source(path, jobs=1, skip_bad=True)
    assert (len(read), len(read.source.left_out)) == (10, 300)
    warned = left_out_lines(path, read)
    assert len(warned) == 11
    assert "290 more" in warned[-1]


def test_a_zip_is_opened_once_not_for_every_chunk(tmp_path, monkeypatch):
    path = tmp_path / "st.zip"
    archive(path, good_members(20))
    opened = []
    original = zipfile.ZipFile._RealGetContents
    monkeypatch.setattr(
        zipfile.ZipFile,
        "_RealGetContents",
        lambda self: (opened.append(self), original(self))[1],
    )
    assert len(read_source(path, jobs=1)) == 200  # seven chunks
    assert len(opened) == 2  # to list and to read
    archive(path, good_members(2))  # another file of that name is read anew
    assert len(read_source(path, jobs=1)) == 20


def test_what_was_read_before_a_worker_ended_is_not_read_again(monkeypatch):
    def results_of(calls, jobs):
        yield ["a"]
        raise TerminatedWorkerError

    def read_carefully(path, names):
        return [f"{name}, carefully" for name in names]

    monkeypatch.setattr("pipeline.data.archive.results_of", results_of)
    monkeypatch.setattr("pipeline.data.archive._read_carefully", read_carefully)
    found = _read_chunks("st.zip", [["a"], ["b"], ["c", "d"]], jobs=2)
    assert list(found) == [["a"], ["b, carefully"], ["c, carefully", "d, carefully"]]


def test_a_file_that_ends_its_worker_is_named(tmp_path, monkeypatch):
    """In the second of three parts, and then in halves of it, each in new processes."""
    path = tmp_path / "st.zip"
    archive(path, {**good_members(), "5/deadly.mat": deadly.CONTENT})
    monkeypatch.setattr("pipeline.data.archive.CHUNK", 4)
    monkeypatch.setattr("pipeline.data.archive._read_members", deadly.read_members)
    with pytest.raises(UserError, match=r"1 of 11 .*5/deadly\.mat .*process"):
        read_source(path, jobs=2)


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize(
    ("limit", "value", "said"),
    [("MOST_EVENTS", 30, "30 events"), ("MOST_BYTES", 20_000, "20,000 bytes")],
)
def test_a_source_that_holds_too_much_is_refused(tmp_path, monkeypatch, limit, value, said, jobs):
    """20 recordings of a few events each: each is within all limits."""
    monkeypatch.setattr(f"pipeline.data.budget.{limit}", value)
    archive(tmp_path / "st.zip", good_members(2))
    with pytest.raises(UserError, match=rf"st\.zip: .* {said}"):
        read_source(tmp_path / "st.zip", jobs=jobs)


def test_nothing_more_is_read_of_a_source_that_holds_too_much(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.data.budget.MOST_EVENTS", 5)
    archive(tmp_path / "st.zip", good_members(2))
    names = [name for name, _ in list_source(tmp_path / "st.zip").recordings]
    read = []
    monkeypatch.setattr(
        "pipeline.data.archive.read_file",
        lambda name, content: read.append(name) or read_file(name, content),
    )
    with pytest.raises(UserError, match=" 5 events"):
        _read_members(tmp_path / "st.zip", names)
    assert len(read) < 5


def test_refused_files_count_as_what_they_may_have_been():
    spent = Spent()
    spent.add("is damaged", 1000)
    assert spent.bytes == 1_032_000
    spent.add("is damaged", 10**9)
    assert spent.bytes < 200_000_000


def test_more_files_than_any_source_has(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.data.archive.MOST_FILES", 19)
    archive(tmp_path / "st.zip", good_members(2))
    with pytest.raises(UserError, match=r"st\.zip: .* 20 .* 19\b"):
        list_source(tmp_path / "st.zip")


def test_a_class_of_thousands_of_digits_is_one_line(tmp_path):
    archive(tmp_path / "st.zip", {**good_members(2), f"{'7' * 5000}/a.mat": mat5(x=1.0)})
    with pytest.raises(UserError, match=r"7/a.mat .* 255 "):
        read_source(tmp_path / "st.zip", jobs=1)


def test_classes_are_in_the_order_of_their_numbers():
    names = ["10", "9", "a10", "a9", "007", "7", "8" * 5000, "9" * 4999, "\u0663"]
    assert sorted(names, key=class_order) == [
        *("007", "7", "9", "10", "9" * 4999, "8" * 5000, "a9", "a10", "\u0663"),
    ]


@pytest.mark.parametrize(
    ("make", "said"), [(lambda path: path.symlink_to("nowhere"), "link"), (os.mkfifo, "file")]
)
@pytest.mark.parametrize("name", ["3/x.mat", "11", "3/x"])
def test_what_is_in_a_folder_and_is_no_file_is_said(tmp_path, make, said, name):
    """A link to a disk that is not there would be a class that is missing."""
    for member, content in good_members(2, root="").items():
        (tmp_path / "data" / member).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "data" / member).write_bytes(content)
    (tmp_path / "data" / ".#lock").symlink_to("nowhere")  # as editors make them
    assert len(read_source(tmp_path / "data", jobs=1)) == 20
    make(tmp_path / "data" / name)
    with pytest.raises(UserError, match=f"1 of 21 .*{name} .*{said}"):
        read_source(tmp_path / "data", jobs=1)


@pytest.mark.parametrize("read", [read_source, list_source])
def test_a_pipe_is_not_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "st.zip")
    with pytest.raises(UserError, match=r"st\.zip: .*a pipe"):
        read(tmp_path / "st.zip")
