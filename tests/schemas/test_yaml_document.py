import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.schemas.problems import InvalidInput
from seamosaic.schemas.yaml_document import decode, dotted, parse


def problem_of(content: str | bytes):
    with pytest.raises(InvalidInput) as caught:
        parse(content, "f.yaml")
    (problem,) = caught.value.problems
    return problem


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("no", "no"),
        ("1e-3", 1e-3),
        ("-.5", -0.5),
        ("0.40", 0.4),
        ("2026-06-03", "2026-06-03"),
        ("12:30", "12:30"),
        ("010", 10),
        ("true", True),
        ("~", None),
        ("-.inf", -math.inf),
        ("1_000", "1_000"),
        ("'7'", "7"),
        ("<<", "<<"),
    ],
)
def test_scalars_follow_yaml_1_2(text: str, value: object) -> None:
    read = parse(f"a: {text}", "f.yaml").value
    assert read == {"a": value}
    assert type(read["a"]) is type(value)  # type: ignore[index]


def test_nan_is_a_number() -> None:
    value = parse("a: .nan", "f.yaml").value
    assert math.isnan(value["a"])  # type: ignore[index]


def test_lines_of_keys_and_items() -> None:
    document = parse("a: 1\n\nb:\n  c:\n    - 1\n    -\n      d: 2\n", "f.yaml")
    assert document.value == {"a": 1, "b": {"c": (1, {"d": 2})}}
    lines = {path: document.line(path) for path in [(), ("a",), ("b",), ("b", "c"), ("b", "c", 0), ("b", "c", 1, "d")]}
    assert list(lines.values()) == [1, 1, 3, 4, 5, 7]
    # What is not there is looked for where it would have to be.
    assert document.line(("b", "missing")) == 3
    assert document.line(("b", "c", 7)) == 4
    assert dotted(("b", "c", 1, "d")) == "b.c.1.d"


def test_duplicate_keys_are_found_at_every_depth() -> None:
    problems = parse("a: 1\nb: {c: 1,\n c: 2}\na: 3\n", "f.yaml").problems
    assert [(p.line, p.key) for p in problems] == [(3, "b.c"), (4, "a")]
    assert "first on line 1" in problems[1].found


def test_a_byte_order_mark_is_no_text() -> None:
    assert parse("\ufeffa: 1".encode(), "f.yaml").value == {"a": 1}
    assert parse("\ufeffa: 1", "f.yaml").value == {"a": 1}


def test_not_utf_8_names_the_line() -> None:
    problem = problem_of("a: 1\nb: caf\xe9\n".encode("latin-1"))
    assert (problem.line, problem.found) == (2, "a byte that is not UTF-8 (0xe9)")


@pytest.mark.parametrize("text", ["", "# only a comment\n", "---\n"])
def test_empty_files_have_no_value(text: str) -> None:
    assert parse(text, "f.yaml").value is None


@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("a: 1\nb: c: d\n", 2, "indentation"),
        ("a: [1,\nb: 2\n", 3, "brackets"),
        ("a: 1\n\tb: 2\n", 2, "spaces"),
        ("a: 1\n---\nb: 2\n", 2, "indentation"),
        ("a: 1\nb: \x07\n", 2, "UTF-8"),
        ("a: 'open\n", 2, "quotes"),
        ("a: *nowhere\n", 1, "indentation"),
    ],
)
def test_syntax_errors_have_a_line_and_a_remedy(text: str, line: int, word: str) -> None:
    problem = problem_of(text)
    assert problem.line == line
    assert word in problem.remedy


def test_hostile_yaml_is_refused_not_run() -> None:
    assert "nested" in problem_of("- " * 700).found
    assert "tag" in parse("a: !!python/object/apply:os.system [x]\nb: !!python/name:os x", "f").problems[0].found
    assert "alias" in parse("a: &x [*x]", "f").problems[0].found
    assert "tag" in parse(f"a: {'9' * 5000}", "f").problems[0].found
    bomb = "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
    assert parse(bomb, "f").problems == []


_TEXTS = st.text(st.characters(categories=["L", "N", "P", "S", "Zs"], exclude_characters="\ufeff"), max_size=20)
_LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(10**12), 10**12)
    | st.floats(allow_nan=False, allow_infinity=False)
    | _TEXTS
)
_TREES = st.recursive(
    _LEAVES,
    lambda below: st.lists(below, max_size=4) | st.dictionaries(_TEXTS, below, max_size=4),
    max_leaves=12,
)


@settings(deadline=None, max_examples=60)
@given(st.dictionaries(_TEXTS, _TREES, max_size=5))
def test_json_is_yaml(tree: dict) -> None:
    text = json.dumps(tree, ensure_ascii=False)
    document = parse(text, "f.yaml")
    assert document.problems == []
    assert json.loads(json.dumps(document.value)) == tree


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_any_bytes_are_read_or_refused(content: bytes) -> None:
    try:
        found = parse(content, "f.yaml").problems
    except InvalidInput as error:
        found = list(error.problems)
    assert all(problem.file == "f.yaml" and problem.remedy for problem in found)


def test_decode_hands_text_through() -> None:
    assert decode("x", "f") == "x"
