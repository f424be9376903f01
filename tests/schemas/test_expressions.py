"""Expressions that select missions: what they select, and what is no expression."""

import pytest
from pydantic_core import PydanticCustomError
from seamosaic.schemas.expressions import MISSION_NAMES, check_expression, compile_expression
from seamosaic.schemas.problems import InvalidInput

ROW = {
    "id": "vortex-2026-06-03-a",
    "title": "Posidonia, like 2026-05-01 and before",
    "platform": "Vortex",
    "start": "2026-06-03T02:14:10Z",
    "end": "2026-06-03T08:00:00Z",
    "images": 6250,
    "sigma_m": 0.004,
}


@pytest.mark.parametrize(
    ("text", "selected"),
    [
        ('platform == "Vortex"', True),
        ("platform == 'Vortex' and start >= 2026-06-01", True),
        ("platform == 'Vortex' and start >= 2026-06-04", False),
        ("start >= 2026-06", True),
        ("2026-06-03T02:00:00Z <= start < 2026-06-03T03:00:00Z", True),
        ("id like 'vortex-2026-*'", True),
        ("not id like 'vortex-*' or images < 100", False),
        ("id in ('other', 'vortex-2026-06-03-a')", True),
        ("'Posidonia' in title", True),
        ("title == 'Posidonia, like 2026-05-01 and before'", True),
        ("sigma_m > 0.003 and sigma_m > -1", True),
        ("cells > 0", False),
        ("cells < 1", False),
        ("not cells > 0", True),
        ("images > 'many'", False),
    ],
)
def test_what_is_selected(text, selected):
    assert compile_expression(text)(ROW) is selected


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("platfrom == 'Vortex'", "the unknown name platfrom"),
        ("__import__('os').system('true')", "no comparison"),
        ("id.__class__ == 1", "no comparison"),
        ("[x for x in id]", "no comparison"),
        ("(lambda: 1)() == 1", "no comparison"),
        ("images + 1 > 2", "no comparison"),
        ("id[0] == 'v'", "no comparison"),
        ("platform = 'Vortex'", "syntax"),
        ("platform == b'x'", "the value b'x'"),
        ("start >= 2026", "a text beside a number"),
        ("", "syntax"),
    ],
)
def test_what_is_no_expression_is_said(text, fault):
    with pytest.raises(InvalidInput, match=r"--where") as caught:
        compile_expression(text)
    assert fault in str(caught.value)
    assert "platform == 'Vortex'" in str(caught.value)


def test_what_decides_parameters_may_not_speak_of_their_results():
    assert check_expression("platform == 'Vortex'") == "platform == 'Vortex'"
    with pytest.raises(PydanticCustomError, match="unknown name cells"):
        check_expression("cells > 10")
    assert "cells" not in MISSION_NAMES
