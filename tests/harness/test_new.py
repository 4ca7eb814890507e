"""Repositories that `analogrig new` writes: their tests pass, and fail where the estimator is broken."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from pathlib import Path

import pytest

from analogrig.cli import main
from analogrig_new.new_command import _FOLDERS, _TEMPLATES
from tests.harness.commands import error_of
from tests.wheels import run

KINDS = sorted(_FOLDERS)

BREAKS = {
    "ceiling": (r"(define CEILING +)30\.0", r"\g<1>300.0"),
    "stale regressor": (r"self->u\[0\], self->u\[1\], 1\.0", "self->u[1], self->u[1], 1.0"),
    "swapped parameters": (r"= \(float\)self->theta\[i\];", "= (float)self->theta[(i < 2) ? 1 - i : i];"),
}
"""Mistakes in estimator.c: a pattern, and what replaces it."""

ALL = "ANALOGRIG_ALL" in os.environ
"""True under `make repositories`, which runs every test of every kind and plants every mistake."""

QUICK = {} if ALL else dict.fromkeys(("lines", "can", "python"), "-k learned")
"""Arguments of pytest for kinds whose tests take longer."""


def make(programs: Path, repository: Path, *words: str, status: int = 0) -> str:
    return run("make", *words, f"PYTHON={programs / 'python'}", cwd=repository, status=status)


@pytest.fixture(
    scope="module", params=[pytest.param(kind, marks=() if kind == "c" else pytest.mark.heavy) for kind in KINDS]
)
def repository(
    request: pytest.FixtureRequest, users_environment: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A repository of the kind of the parameter, written from the wheel."""
    folder: Path = tmp_path_factory.mktemp("new") / str(request.param)
    written = run(users_environment / "analogrig", "new", folder, "--kind", str(request.param))
    assert written.endswith(f"next: cd {folder} && make test\n")
    return folder


def test_tests_of_a_new_repository_pass(users_environment: Path, repository: Path) -> None:
    output = make(users_environment, repository, "test", f"PYTEST_ARGS={QUICK.get(repository.name, '')}")
    assert re.search(r"= \d\d passed[ ,]", output), output


def test_every_file_is_written_and_none_twice(repository: Path) -> None:
    assert {".gitignore", ".gitlab-ci.yml", ".github/workflows/test.yml", "README.md"} <= {
        str(path.relative_to(repository)) for path in repository.rglob("*")
    }
    table = (repository / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| `([\w./]+)`", table, re.MULTILINE)
    assert [name for name in named if not (repository / name).exists()] == []


@pytest.mark.heavy
@pytest.mark.parametrize("repository", ["c"], indirect=True)
@pytest.mark.parametrize("broken", BREAKS if ALL else ["stale regressor"])
def test_broken_estimator_fails_with_a_counterexample_that_replays(
    users_environment: Path, repository: Path, broken: str, tmp_path: Path
) -> None:
    copy = shutil.copytree(repository, tmp_path / "copy", ignore=shutil.ignore_patterns("build", "*.so", ".hypothesis"))
    source = copy / "estimator.c"
    text, n = re.subn(*BREAKS[broken], source.read_text(encoding="utf-8"))
    assert n == 1
    source.write_text(text, encoding="utf-8")
    output = make(users_environment, copy, "test", "PYTEST_ARGS=-x", status=2)
    again = re.search(r"^judge it again with: pytest (.*)$", output, re.MULTILINE)
    assert again is not None, output
    judged = run(users_environment / "python", "-m", "pytest", *shlex.split(again[1]), cwd=copy, status=1)
    assert "1 failed" in judged


@pytest.mark.parametrize("repository", ["c"], indirect=True)
def test_missing_package_is_named_in_one_line(environment: Path, repository: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(repository, tmp_path / "copy")
    told = make(environment, copy, "test", status=2).splitlines()
    assert "pip install 'analogrig[pytest]'" in told[0]
    assert len(told) == 2  # the other one is make's own


def test_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    assert error_of("new", str(tmp_path)).endswith("holds mine: name a folder that is absent or empty\n")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    assert error_of("new", str(tmp_path / "mine")).count("\n") == 1


def test_empty_git_repository_is_accepted(tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    assert main(["new", str(tmp_path)]) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_no_two_folders_hold_the_same_file(kind: str) -> None:
    files = [
        path.relative_to(_TEMPLATES / part) for part in _FOLDERS[kind] for path in (_TEMPLATES / part).rglob("*.*")
    ]
    assert len(files) == len(set(files))
