"""Command ``effects``: text, JSON and picture of the same figures."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path

from tests.harness.commands import error_of, output_of


def test_text_json_and_picture_have_the_same_figures(tmp_path: Path) -> None:
    picture = tmp_path / "effects.svg"
    rows = json.loads(output_of("effects", "--set", "shock", "--json", "--out", str(picture)))["sets"]["shock"]
    assert rows == sorted(rows, key=lambda row: -row["median_lsb"])
    titles = [title.text or "" for title in ET.parse(picture).iter("{http://www.w3.org/2000/svg}title")]  # noqa: S314
    assert titles == [f"{row['effect']}: {row['median_lsb']:.3g} LSB" for row in rows]
    lines = output_of("effects", "--set", "shock").splitlines()
    assert [line[:40].rsplit("  ", 1)[0].strip() for line in lines[4:]] == [row["effect"] for row in rows]


def test_a_picture_of_another_kind_is_refused() -> None:
    assert "must end with .svg" in error_of("effects", "--out", "effects.png")
