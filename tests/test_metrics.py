"""The structure keeps what design promises: imports run one way, one name means one thing."""

from __future__ import annotations

import pytest

from tests import metrics


@pytest.fixture(scope="module")
def tree() -> metrics.Tree:
    return metrics.read(None)


def made(**modules: str) -> metrics.Tree:
    files = {f"harness/analogrig/{name.replace('__', '/')}.py": text for name, text in modules.items()}
    return metrics.Tree("made", {"harness/analogrig/__init__.py": "", **files})


def test_imports_run_one_way(tree: metrics.Tree) -> None:
    assert metrics.upward(metrics.arrows(tree)) == []
    assert metrics.circles(metrics.arrows(tree)) == []


def test_upward_import_is_found_wherever_it_stands() -> None:
    below = made(rigs__rig="def f():\n    from analogrig.cli import main\n", cli__main="import analogrig.rigs.rig\n")
    assert metrics.upward(metrics.arrows(below)) == [("rigs", "cli")]
    assert metrics.circles(metrics.arrows(below)) == [{"rigs", "cli"}]


def test_modules_beside_the_core_import_in_no_circle(tree: metrics.Tree) -> None:
    inside = [
        circle
        for circle in metrics.circles(metrics.module_arrows(tree))
        if not any(name.startswith("analogrig_emulator.machine") for name in circle)
    ]
    assert inside == []


def test_circle_of_modules_is_found_within_functions_too() -> None:
    ring = made(one="def f():\n    from analogrig.two import g\n", two="from analogrig.one import f\n")
    assert metrics.circles(metrics.module_arrows(ring)) == [{"analogrig.one", "analogrig.two"}]
    typed = made(one="if TYPE_CHECKING:\n    from analogrig.two import g\n", two="from analogrig.one import f\n")
    assert metrics.circles(metrics.module_arrows(typed)) == []


def test_figures_of_small_things() -> None:
    tree = made(one="def _f():\n    return 1\n\n\nprint(_f())\n", two="class A(B):\n    pass\n\n\nclass B:\n    pass\n")
    assert metrics.called_once(tree) == ["harness/analogrig/one.py: _f"]
    assert metrics.class_depths(tree) == {"A": 2, "B": 1}
    assert len(metrics.small_modules(tree)) == 2


def test_docstrings_can_be_read_alone(tree: metrics.Tree) -> None:
    assert metrics.share_of_bad(tree) <= 0.03
    assert metrics.share_of_bad(made(run='"""Whether it runs."""\nN = 1\n"""The number."""\n')) == 0.5


def test_type_has_one_meaning(tree: metrics.Tree) -> None:
    assert metrics.doubled(tree) == []


def test_no_caller_asks_for_a_concrete_rig_or_device(tree: metrics.Tree) -> None:
    assert metrics.isinstances(tree) == 0
    assert metrics.isinstances(made(bench="isinstance(rig, EmulatorRig)")) == 1
