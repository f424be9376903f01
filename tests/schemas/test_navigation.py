import csv
import io
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.schemas.navigation import (
    load_image_times,
    load_navigation,
    load_tide,
    read_image_times,
    read_navigation,
    read_tide,
)
from seamosaic.schemas.problems import InvalidInput, Problem
from seamosaic.schemas.timestamps import iso, to_ns

HEADER = "time,latitude,longitude,depth,altitude,roll,pitch,heading"
GOOD = "43.04,6.01,12.0,3.1,0.1,-0.2,20"
T0 = to_ns(datetime(2026, 6, 3, 2, 14, 10, tzinfo=UTC))


def navigation(*rows: str, header: str = HEADER) -> str:
    return "\n".join([header, *rows]) + "\n"


def row(second: int, cells: str = GOOD) -> str:
    return f"{iso(T0 + second * 10**9)},{cells}"


def problems(content: str | bytes) -> list[Problem]:
    with pytest.raises(InvalidInput) as caught:
        load_navigation(content, "n.csv")
    assert all(problem.file == "n.csv" and problem.remedy for problem in caught.value.problems)
    return list(caught.value.problems)


def test_a_good_file() -> None:
    read = load_navigation(navigation(row(0), row(1, "43.05,-6.02,-198.3,,0,0,359.5")), "n.csv")
    assert read.ns.tolist() == [T0, T0 + 10**9]
    assert (read.latitude[1], read.longitude[1], read.depth[1], read.heading[1]) == (43.05, -6.02, -198.3, 359.5)
    assert np.isnan(read.altitude[1])
    assert read.sigma == {}


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\n\n"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace(",", " , "),
        lambda text: text.replace("43.04", '"43.04"'),
        lambda text: text.rstrip("\n"),
        lambda text: text.encode(),
        lambda text: text.replace("2026-06-03T02:14:10Z", "1780452850").replace(
            "2026-06-03T02:14:11Z", "1.780452851e9"
        ),
    ],
)
def test_harmless_differences(spoil) -> None:
    text = navigation(row(0), row(1))
    read, plain = load_navigation(spoil(text), "n.csv"), load_navigation(text, "n.csv")
    for one, other in zip(read[:-1], plain[:-1], strict=True):
        np.testing.assert_array_equal(one, other)


def test_columns_in_any_order_with_sigmas() -> None:
    text = f"sigma_depth,heading,{HEADER.removesuffix(',heading')},sigma_horizontal\n0.1,20,{row(0)[:-3]},0.5\n"
    read = load_navigation(text, "n.csv")
    assert read.heading[0] == 20
    assert {name: values.tolist() for name, values in read.sigma.items()} == {"depth": [0.1], "horizontal": [0.5]}


def test_sigma_of_latitude_and_longitude_become_one() -> None:
    text = navigation(row(0, GOOD + ",0.3,0.4"), header=HEADER + ",sigma_latitude,sigma_longitude")
    assert load_navigation(text, "n.csv").sigma["horizontal"][0] == pytest.approx(0.3535534)


def test_every_wrong_cell_has_its_line_and_column() -> None:
    text = navigation(
        row(0, "nan,6.01,12,3.1,0,0,20"),
        row(1, "43.04,inf,12,3.1,0,0,20"),
        row(2, "43.04,6.01,12 m,3.1,0,0,20"),
        "",
        row(3, "91,6.01,12,-1,0,0,20"),
        row(4, "43.04,6.01,12,3.1,0,91,1_0"),
        "soon,43.04,6.01,12,3.1,0,0,20",
        row(6),
        row(7, "43.04,6.01"),
    )
    found = {(problem.line, problem.key): problem.found for problem in problems(text)}
    assert found == {
        (2, "latitude"): "'nan'",
        (3, "longitude"): "'inf'",
        (4, "depth"): "'12 m'",
        (6, "latitude"): "'91'",
        (6, "altitude"): "'-1'",
        (7, "pitch"): "'91'",
        (7, "heading"): "'1_0'",
        (8, "time"): "'soon'",
        (10, ""): "3 cells",
    }


def test_times_that_stand_still_or_go_back() -> None:
    found = problems(navigation(row(0), row(1), row(1), row(5), row(3), row(6)))
    assert [(problem.line, problem.key) for problem in found] == [(4, "time"), (6, "time")]
    assert found[0].found == "2026-06-03T02:14:11Z, the time of line 3"
    assert found[1].found == "2026-06-03T02:14:13Z after 2026-06-03T02:14:15Z"
    read, _ = read_navigation(navigation(row(0), row(1), row(1), row(5), row(3)), "n.csv")
    assert np.all(np.diff(read.ns) > 0)
    assert len(read.ns) == 4


def test_twenty_of_a_kind_are_listed() -> None:
    found = problems(navigation(*(row(i, "43.04,6.01,NaN,3.1,0,0,20") for i in range(1000))))
    assert len(found) == 21
    assert [problem.line for problem in found[:20]] == list(range(2, 22))
    assert found[20].found == "the same on 980 more lines from here"


@pytest.mark.parametrize(
    ("header", "key", "word"),
    [
        (HEADER.replace("heading", "Heading"), "Heading", "Did you mean heading"),
        (HEADER.replace(",roll", ""), "roll", "Add the column roll"),
        (HEADER + ",speed", "speed", "Remove the column"),
        (HEADER + ",", "column 9", "Remove the column"),
        (HEADER + ",depth", "depth", "Remove one"),
        (HEADER.replace(",", ";"), "", "commas"),
        (HEADER.replace(",", "\t"), "", "commas"),
    ],
)
def test_wrong_headers(header: str, key: str, word: str) -> None:
    cells = ",".join(["1"] * (header.count(",") + 1))
    found = [problem for problem in problems(f"{header}\n{cells}\n") if problem.line == 1]
    assert any(problem.key == key and word in problem.remedy for problem in found)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("", "an empty file"),
        ("\n \n", "an empty file"),
        (HEADER + "\n", "no rows"),
        (b"time\xff", "not UTF-8"),
        (navigation(row(0, "43.04,6.01,,3.1,0,0,20")), "no value on any row"),
        (navigation(f'"{row(0)}'), "cells"),
        ('"' + "x" * 140_000, "field larger than"),
    ],
)
def test_files_without_data(content: str | bytes, word: str) -> None:
    assert any(word in problem.found for problem in problems(content))


_COLUMN = {
    "latitude": (-90, 90),
    "longitude": (-180, 180),
    "depth": (-200, 6000),
    "altitude": (0, 100),
    "roll": (-180, 180),
    "pitch": (-90, 90),
    "heading": (0, 360),
    "sigma_depth": (0.001, 10),
}


@st.composite
def _samples(draw) -> dict[str, list]:
    times = sorted(draw(st.sets(st.integers(0, 10**15), min_size=1, max_size=6)))
    columns: dict[str, list] = {"time": [T0 + time for time in times]}
    for name, (least, most) in _COLUMN.items():
        value = st.floats(least, most)
        column = draw(st.lists(st.none() | value, min_size=len(times), max_size=len(times)))
        column[0] = draw(value)  # at least one
        columns[name] = column
    return columns


@settings(deadline=None, max_examples=40)
@given(_samples(), st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL]), st.randoms(use_true_random=False))
def test_navigation_round_trip(columns: dict[str, list], quoting: int, random) -> None:
    names = list(columns)
    random.shuffle(names)
    text = io.StringIO()
    writer = csv.writer(text, quoting=quoting)  # type: ignore[arg-type]
    writer.writerow(names)
    for i in range(len(columns["time"])):
        cells = {name: column[i] for name, column in columns.items()}
        writer.writerow([iso(cells[n]) if n == "time" else "" if cells[n] is None else repr(cells[n]) for n in names])
    read = load_navigation(text.getvalue(), "n.csv")
    assert read.ns.tolist() == columns["time"]
    for name in _COLUMN:
        values = read.sigma["depth"] if name == "sigma_depth" else getattr(read, name)
        np.testing.assert_array_equal(values, [np.nan if v is None else v for v in columns[name]])


@settings(deadline=None, max_examples=60)
@given(st.text(st.sampled_from('time,height\n"0123456789.-+eEnaif:TZ \r'), max_size=80))
def test_any_text_is_read_or_explained(text: str) -> None:
    for read in (read_navigation, read_tide, read_image_times):
        _, found = read("time,height\n" + text, "x.csv")
        assert all(problem.file == "x.csv" for problem in found)


def test_tide() -> None:
    tide = load_tide(f"time,height\n{iso(T0)},0.5\n{iso(T0 + 1)},\n{iso(T0 + 2)},0.7\n", "t.csv")
    assert (tide.ns.tolist(), tide.height.tolist()) == ([T0, T0 + 2], [0.5, 0.7])
    with pytest.raises(InvalidInput, match="no value"):
        load_tide(f"time,height\n{iso(T0)},\n", "t.csv")
    with pytest.raises(InvalidInput, match="-100 to 100 metres"):
        load_tide(f"time,height\n{iso(T0)},512\n", "t.csv")


def test_image_times() -> None:
    text = f'image,time\na.JPG,{iso(T0)}\n"b, left.JPG",{T0 // 10**9}.5\n'
    assert load_image_times(text, "t.csv") == {"a.JPG": T0, "b, left.JPG": T0 + 500_000_000}
    with pytest.raises(InvalidInput, match=r"t.csv:4: image: found 'a', which line 2 has too"):
        load_image_times("image,time\na,1\nb,2\na,3\n", "t.csv")
    with pytest.raises(InvalidInput, match=r"t.csv:2: time: found 'x'"):
        load_image_times("image,time\na,x\n", "t.csv")
