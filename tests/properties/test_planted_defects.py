"""The harness can fail: a planted defect is found by the shipped property that is to find it.

Every sixth one here; `make defects` tries all.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.properties.planted import README, Defect, defects, planted, simplest, tried


def test_there_are_twenty_defects_and_each_has_its_row_in_the_readme() -> None:
    names = [defect.name for defect in defects()]
    assert len(set(names)) == len(names) >= 20
    rows = README.read_text(encoding="utf-8")
    assert [name for name in names if f"| {name} | " not in rows] == []


@pytest.mark.heavy
@pytest.mark.parametrize("defect", defects()[::6], ids=lambda defect: defect.name.replace(" ", "-"))
def test_planted_defect_is_found(defect: Defect, tmp_path: Path) -> None:
    found = tried(planted(defect, tmp_path), defect.property, tmp_path, shrunk=False)
    assert found.failed, found.output
    assert "1 failed" in found.output or "2 failed" in found.output
    assert found.why
    plays = defect.property != "test_device_converses_as_catalogued"  # a conversation has no samples to keep
    assert (simplest(found.runs) != "-") == plays, "a counterexample is left wherever something was played"


def test_text_that_is_not_in_the_source_is_no_defect(tmp_path: Path) -> None:
    nowhere = Defect("nothing", "core/est.c", before="no such text", after="another", property="test_none")
    with pytest.raises(ValueError, match="nothing: its text stands 0 times in core/est.c"):
        planted(nowhere, tmp_path)
