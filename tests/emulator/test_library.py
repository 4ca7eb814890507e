"""Finding the compiled engine."""

from __future__ import annotations

from pathlib import Path

import pytest

from emulator import EngineError, library


def test_an_engine_that_is_not_built_is_reported_with_the_line_that_builds_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(library, "_HERE", tmp_path)
    with pytest.raises(EngineError, match="is not built in .*: run `pip install -e .`, or `cc .*engine.c`"):
        library.load.__wrapped__()


def test_an_engine_that_does_not_load_is_reported_with_its_path(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "_engine.so").write_bytes(b"no library")
    monkeypatch.setattr(library, "_HERE", tmp_path)
    with pytest.raises(EngineError, match=r"_engine.so does not load .*: rebuild it"):
        library.load.__wrapped__()
