from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.schemas.timestamps import check_pattern, iso, name_regex, parse_time, parse_times, time_in_name, to_ns

NS = to_ns(datetime(2026, 6, 3, 2, 14, 10, 136751, UTC))


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("2026-06-03T02:14:10.136751Z", NS),
        ("2026-06-03 02:14:10.136751", NS),
        ("2026-06-03T04:14:10.136751+02:00", NS),
        ("20260603T021410.136751Z", NS),
        ("2026-06-03T02:14:10.136751123Z", NS + 123),
        ("2026-06-03T02:14:10,136751", NS),
        ("2026-06-03T02:14Z", NS - 10_136_751_000),
        (f"{NS // 10**9}.136751", NS),
        ("1.780452850136751e9", NS),
        ("0", 0),
        ("12.5", 12_500_000_000),
    ],
)
def test_times_that_are_understood(text: str, ns: int) -> None:
    assert parse_time(text) == ns
    assert parse_times([text]).ns[0] == ns


@pytest.mark.parametrize(
    "text",
    [
        "",
        "now",
        "NaT",
        "nan",
        "2026-06-03",
        "2026-13-03T00:00:00Z",
        "2026-06-03T24:61:00Z",
        "1780452850136",  # milliseconds
        "-5",
        "12:30:00",
        "0001-01-01T00:00:00Z",
        "03/06/2026 02:14",
    ],
)
def test_times_that_are_refused(text: str) -> None:
    assert parse_time(text) is None
    times = parse_times(["2026-06-03T02:14:10Z", text])
    assert times.bad.tolist() == [1]
    assert times.ns[0] == NS - 136_751_000


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.datetimes(datetime(1971, 1, 1), datetime(2190, 1, 1)), min_size=1, max_size=5),
    st.integers(-12 * 60, 14 * 60),
)
def test_iso_and_posix_round_trip(moments: list[datetime], minutes: int) -> None:
    ns = [to_ns(moment) for moment in moments]
    assert parse_times([iso(value) for value in ns]).ns.tolist() == ns
    assert parse_times([f"{value // 10**9}.{value % 10**9:09d}" for value in ns]).ns.tolist() == ns
    zone = timezone(timedelta(minutes=minutes))
    local = [moment.replace(tzinfo=UTC).astimezone(zone).isoformat() for moment in moments]
    times = parse_times(local)
    assert times.ns.tolist() == ns
    assert times.bad.dtype == np.int64


@pytest.mark.parametrize(
    ("pattern", "stem", "ns"),
    [
        ("%Y%m%dT%H%M%S.%fZ", "V_20260603T021410.136751Z", NS),
        ("%Y%m%dT%H%M%S.%fZ", "V_20260603T021410.136751Z_left (2)", NS),
        ("%Y%m%d_%H%M%S", "IMG_20260603_021410_HDR", NS - 136_751_000),
        ("%Y-%j-%H%M%S", "x2026-154-021410", NS - 136_751_000),
        ("%y%m%d%H%M%S", "260603021410", NS - 136_751_000),
        ("%s.%f", "cam1780452850.136751", NS),
        ("%Y%m%dT%H%M%S%z", "20260603T041410+0200", NS - 136_751_000),
        ("%Y%m%d%H%M%S%z", "20260603021410Z", NS - 136_751_000),
        ("100%%_%Y%m%d%H%M", "100%_202606030214", NS - 10_136_751_000),
        ("%H%M%S.%f_%d%m%Y", "a021410.136_03062026", NS - 751_000),
        # A number that only looks like the beginning is passed over.
        ("%Y%m%d%H%M%S", "99920260603021410", NS - 136_751_000),
    ],
)
def test_times_in_names(pattern: str, stem: str, ns: int) -> None:
    assert check_pattern(pattern) == pattern
    assert time_in_name(name_regex(pattern), stem) == ns


@pytest.mark.parametrize("stem", ["", "V_20260603", "V_20261303T021410.1Z", "V_20260603T021410.136751", "٢٠٢٦"])
def test_names_without_a_time(stem: str) -> None:
    assert time_in_name(name_regex("%Y%m%dT%H%M%S.%fZ"), stem) is None


def test_day_366_of_a_common_year_is_no_day() -> None:
    assert time_in_name(name_regex("%Y-%j-%H%M"), "2026-366-0000") is None


@settings(deadline=None, max_examples=60)
@given(
    st.datetimes(datetime(1970, 1, 1), datetime(2199, 1, 1)),
    st.sampled_from(["%Y%m%dT%H%M%S.%fZ", "%Y-%j_%H-%M-%S.%f", "%d.%m.%Y %H:%M:%S,%f"]),
    st.text(st.characters(categories=["L", "P"]), max_size=5),
    st.text(st.characters(categories=["L", "P"]), max_size=5),
)
def test_strftime_round_trip(moment: datetime, pattern: str, before: str, after: str) -> None:
    stem = before + moment.strftime(pattern).rjust(4, "0") + after
    assert time_in_name(name_regex(pattern), stem) == to_ns(moment)
