"""Tables in plain text."""

from deploy.tables import align_in_blocks, align_rows, shorten_apart, shorten_name


def test_a_table_that_is_too_wide_is_cut_into_blocks():
    rows = [["", *(f"class {i}" for i in range(5))], ["events", *map(str, range(5))]]
    assert align_in_blocks(rows, width=80) == align_rows(rows)
    lines = align_in_blocks(rows, width=25)
    assert max(map(len, lines)) <= 25
    assert [line.split() for line in lines if line.startswith("events")] == [
        ["events", "0", "1"], ["events", "2", "3"], ["events", "4"],
    ]  # fmt: skip
    assert align_in_blocks(rows, width=1)[0].strip() == "class 0"


def test_names_lose_their_middle_and_stay_different():
    assert shorten_name("wave", 8) == "wave"
    assert shorten_name("swipe from the left", 10) == "swipe …eft"
    names = [f"swipe {n} from the left to the right" for n in range(12)]
    short = shorten_apart(names, 12)
    assert len(set(short)) == 12
    assert max(map(len, short)) <= 12
