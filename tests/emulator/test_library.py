"""Finding the compiled engine."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from analogrig_emulator import TICKS_PER_SAMPLE, EngineError
from analogrig_emulator.engine import binding


def test_an_engine_that_is_not_built_is_reported_with_the_line_that_builds_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(binding, "_HERE", tmp_path)
    with pytest.raises(EngineError, match="is not built in .*: run `pip install -e .`, or `make setup`"):
        binding.load.__wrapped__()


def test_an_engine_that_does_not_load_is_reported_with_its_path(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "_engine.so").write_bytes(b"no library")
    monkeypatch.setattr(binding, "_HERE", tmp_path)
    with pytest.raises(EngineError, match=r"_engine.so does not load .*: rebuild it"):
        binding.load.__wrapped__()


def test_the_limits_and_the_structures_are_those_of_the_header() -> None:
    header = Path(binding.__file__).with_name("engine.h").read_text(encoding="utf-8")
    limits = {name: int(value) for name, value in re.findall(r"#define ENGINE_(MAX_\w+|LEVELS) (\d+)", header)}
    assert limits.pop("LEVELS") == TICKS_PER_SAMPLE.bit_length()
    assert limits == {name: getattr(binding, name) for name in limits}
    for structure, name in ((binding.Counts, "engine_counts_t"), (binding.System, "engine_system_t")):
        body = re.search(rf"typedef struct \{{([^}}]*)\}} {name};", header, re.DOTALL)
        assert body is not None
        assert [field[0] for field in structure._fields_] == re.findall(r"^ .*?(\w+);", body[1], re.MULTILINE)
