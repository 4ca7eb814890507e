"""The plugin for pytest: rigs, devices and plays as fixtures, scenario files as tests, counterexamples of failed tests.

Every pytest in whose environment analogrig is installed loads it. A session that uses none of its fixtures and options
is therefore left as it is: every name carries the prefix ``hil``, nothing heavy is imported, no file is written or
collected, the environment is not changed, and no setting of ours ends the session.

The value of an option comes from, in this order: indirect parametrization of its fixture, the command line, the
environment (ANALOGRIG_RIG, ...), the ini file (hil_rig, ...), its default.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from analogrig.rigs import CAPABILITIES
from analogrig.testing.plugin import devices, hil_options, junit, player, scenarios
from analogrig.testing.plugin.hil_options import DUT, HIL_PROFILE, RIG, RUNS_DIR, SCENARIO_DIR, time_limit_s

if TYPE_CHECKING:
    from analogrig.bench import Bench
    from analogrig.devices.device import Device
    from analogrig.rigs.rig import Rig
    from analogrig.testing.statement import Play

# -------------------------------------------------------------------------------------------------------------- session


def pytest_addoption(parser: pytest.Parser) -> None:
    hil_options.add_options(parser)


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    hil_options.check_allow(early_config, early_config.known_args_namespace.hil_allow)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", f"hil_needs(*capabilities): skip where the rig cannot do that: {', '.join(CAPABILITIES)}"
    )
    hil_options.check_command_line(config)
    junit.begin(config)
    hil_options.sessions.append(config)
    config.stash[devices.DEVICES] = devices.Devices()
    devices.assign_owner(config)
    scenarios.add_folder(config)


def pytest_unconfigure(config: pytest.Config) -> None:
    if (open_devices := config.stash.get(devices.DEVICES, None)) is not None:
        open_devices.close()
    if config in hil_options.sessions:
        hil_options.sessions.remove(config)


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    return scenarios.collect_file(file_path, parent)


def pytest_collection_modifyitems(session: pytest.Session, config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        for mark in item.iter_markers("hil_needs"):
            unknown = [*(need for need in mark.args if need not in CAPABILITIES), *mark.kwargs]
            if unknown:
                raise pytest.UsageError(
                    f"{item.nodeid}: hil_needs: no rig is known to {unknown[0]!r}: there are {', '.join(CAPABILITIES)}"
                )
    scenarios.add_complaint(session, items)
    devices.list_owned_tests(config, items)


# ------------------------------------------------------------------------------------------------------------- fixtures


@pytest.fixture
def hil_scenario_dir(request: pytest.FixtureRequest) -> Path | None:
    """The folder of --hil-scenario-dir."""
    value = SCENARIO_DIR.of_fixture(request).value
    return Path(value) if value else None


@pytest.fixture
def hil_runs_dir(request: pytest.FixtureRequest) -> Path:
    """The folder of --hil-runs-dir."""
    return Path(RUNS_DIR.of_fixture(request).value)


@pytest.fixture
def hil_profile(request: pytest.FixtureRequest) -> str:
    """``ci``, ``nightly`` or ``soak``."""
    return HIL_PROFILE.of_fixture(request).value


@pytest.fixture
def hil_rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """The rig of --hil-rig, opened; the test is skipped if it lacks what the mark ``hil_needs`` asks."""
    from analogrig.rigs.description import open_rig

    devices.check_owner(request.node)
    setting = RIG.of_fixture(request)
    with player.in_one_line(setting.by):
        rig = open_rig(setting.value, allow=hil_options.trust_of(request.config))
    with rig:
        for mark in request.node.iter_markers("hil_needs"):
            if missing := sorted(set(mark.args) - rig.capabilities):
                able = ", ".join(sorted(rig.capabilities)) or "nothing but play"
                pytest.skip(
                    f"rig {setting.value} cannot {' and '.join(missing)} (it can {able}): choose another with --hil-rig"
                )
        yield rig


@pytest.fixture
def hil_dut(request: pytest.FixtureRequest) -> Device:
    """The device of --hil-dut, reset and configured as described."""
    devices.check_owner(request.node)
    setting = DUT.of_fixture(request)
    with player.in_one_line(setting.by):
        return request.config.stash[devices.DEVICES].lease(setting.value, hil_options.trust_of(request.config))


@pytest.fixture
def hil_bench(request: pytest.FixtureRequest, hil_rig: Rig, hil_dut: Device) -> Bench:
    """Bench of the rig and device of the session."""
    from analogrig.bench import Bench

    return Bench(hil_rig, hil_dut, time_limit_s=time_limit_s(request.config))


@pytest.fixture
def hil_play(request: pytest.FixtureRequest, hil_bench: Bench) -> Play:
    """``hil_play(scenario, seed=None) -> Played``: a name, a .toml file or a Scenario; by default the seed that it has.

    On the rig ``recording:FILE`` ``hil_play()`` plays the scenario of the recording, by default with its seed.
    A play that is INCONCLUSIVE fails the test with its reason; ``allow_inconclusive=True`` hands it on.
    """
    return player.Player(request.node, hil_bench, is_default=True)


# -------------------------------------------------------------------------------------------------------------- results


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    with player.limits_in_one_line(item), player.keep_examples(item):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    record = player.record_of(item)
    if call.when == "call":
        item.user_properties += [each for played in record.plays for each in junit.play_properties(played)]
        item.user_properties += [("found", f"{record.found[0]!r}"[1:-1])] if record.found else []
    report = yield
    if report.when == "call" and report.failed and (text := player.write_counterexample(item)):
        report.sections.append(("analogrig", text))
    return report
