"""The library of the device that `make mutants` alters builds from the sources as they are."""

from __future__ import annotations

from pathlib import Path

from estimator_c.evidence.mutate import explained
from tests.properties.mutants import SURVIVORS, Build, every_mutant


def test_survivors_with_a_reason_are_mutants_that_there_are() -> None:
    assert explained(SURVIVORS).keys() <= {mutant.key for mutant in every_mutant()}


def test_a_mutant_of_the_library_has_other_code(tmp_path: Path) -> None:
    mutant = next(each for each in every_mutant() if each.function == "EST_TERM_GAIN")
    build, folder = Build(tmp_path / "device"), tmp_path / "mutant"
    folder.mkdir()
    library = build.mutated(mutant, folder)
    assert library is not None
    assert library.read_bytes() != (build.folder / "device.so").read_bytes()
