"""Configuration files: every mistake is one line that names the file, the table and the key."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.rigs.description import open_rig
from analogrig.scenario import Expectations, PotChange, Scenario, Statement
from analogrig_emulator import Excitation

SCENARIO = """
samples = 100
[excitation]
shape = "square"
[[changes]]
sample = 50
mass_kg = 30.0
"""


@dataclass(frozen=True)
class Inner:
    gain: float


@dataclass(frozen=True)
class Outer:
    count: int
    mode: Literal["a", "b"] = "a"
    inner: Inner | None = None
    pairs: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError("count must not be negative")


def test_values_become_the_declared_types() -> None:
    table = {"count": 3, "mode": "b", "inner": {"gain": 2}, "pairs": {"x": [0, 1.5]}}
    assert config.build(Outer, table, "f") == Outer(3, "b", Inner(2.0), {"x": (0.0, 1.5)})


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "f: missing key 'count'"),
        ({"count": 1, "cuont": 2}, "f: unknown key 'cuont' (known: count, mode, inner, pairs)"),
        ({"count": True}, "f: count: must be a whole number below 2^63, not True"),
        ({"count": 1.0}, "f: count: must be a whole number, not 1.0"),
        ({"count": -1}, "f: count must not be negative"),
        ({"count": 1, "mode": "c"}, "f: mode: must be one of 'a', 'b', not 'c'"),
        ({"count": 1, "inner": {"gain": float("nan")}}, "f: inner: gain: must be a number within +-1e+30, not nan"),
        ({"count": 1, "inner": {"gain": 1, "loss": 2}}, "f: inner: unknown key 'loss' (known: gain)"),
        ({"count": 1, "pairs": {"x": [1]}}, "f: pairs.x: must have 2 elements, not 1"),
        ({"count": 1, "pairs": {"x": "12"}}, "f: pairs.x: must be an array, not '12'"),
    ],
)
def test_mistake_is_named_with_its_place(table: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        config.build(Outer, table, "f")
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("samples = 100", "samples = 100\nsampels = 3", "unknown key 'sampels'"),
        ("samples = 100", "samples = 0", "samples must be in 1 .. 10000000, not 0"),
        ("sample = 50", "sample = 100", "the change at sample 100 is beyond the last of 100 samples"),
        ("mass_kg = 30.0", "mass_kg = -30.0", "changes[0]: M must be more than 0, not -30"),
        ("mass_kg = 30.0", "", "changes[0]: a pot change must set a parameter of the program"),
        (
            'shape = "square"',
            'shape = "triangle"',
            "excitation: shape 'triangle' must be one of square, pulse, prbs, sine, sweep, multisine, recorded",
        ),
        (
            'shape = "square"',
            "shape = 'square'\nphase = 1.5",
            "excitation: phase 1.5 must be at least 0 and less than 1 period",
        ),
        ("[excitation]", "[exitation]", "unknown key 'exitation'"),
        ("samples = 100", "samples = ", "not valid TOML"),
    ],
)
def test_scenario_file_with_a_mistake_names_it(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(SCENARIO.replace(old, new))
    with pytest.raises(ConfigurationError) as caught:
        Scenario.load(str(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ('shape = "sweep"', "shape 'sweep' needs end_hz"),
        ('shape = "sweep"\nend_hz = 9.0', "shape 'sweep' needs sweep_s"),
        ('shape = "sweep"\nend_hz = -1.0\nsweep_s = 1.0', "end_hz -1.0 must be 0 to 1e12"),
        ('shape = "sweep"\nend_hz = 9.0\nsweep_s = 0.0', "sweep_s 0.0 must be positive and finite"),
        ('shape = "sine"\nend_hz = 9.0', "end_hz 9.0 is for the shape sweep"),
        ('shape = "sine"\nduty = 0.4', "duty 0.4 is for the shape pulse"),
        ('shape = "sine"\nfrequency_hz = nan', "frequency_hz: must be a number within +-1e+30, not nan"),
        ('shape = "multisine"', "shape 'multisine' needs harmonics"),
        ('shape = "multisine"\nharmonics = []', "harmonics () must be different whole numbers, 1 to 1000"),
        ('shape = "multisine"\nharmonics = [1, 1]', "harmonics (1, 1) must be different whole numbers"),
        ('shape = "multisine"\nharmonics = [0]', "harmonics (0,) must be different whole numbers"),
        ('shape = "multisine"\nharmonics = [1.5]', "harmonics[0]: must be a whole number, not 1.5"),
        ('shape = "square"\nharmonics = [1]', "harmonics (1,) is for the shape multisine"),
        ('shape = "recorded"', "shape 'recorded' needs samples_v"),
        ('shape = "recorded"\nsamples_v = []', "samples_v must hold 1 to 1000000 samples, not 0"),
        ('shape = "recorded"\nsamples_v = [0.0, 2e3]', "samples_v[1] 2000.0 must be within +-1000 V"),
        ('shape = "recorded"\nsamples_v = [1.0]\nhigh_v = 9.0', "high_v 9.0 is not for the shape recorded"),
    ],
)
def test_excitation_with_a_mistake_is_named_in_one_line(tmp_path: Path, fields: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(f"samples = 100\n[excitation]\n{fields}\n")
    with pytest.raises(ConfigurationError) as caught:
        Scenario.load(str(path))
    assert str(caught.value).startswith(f"{path}: excitation: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_recorded_excitation_has_no_phase_to_draw(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('samples = 9\nrandom_phase = true\n[excitation]\nshape = "recorded"\nsamples_v = [1.0]\n')
    with pytest.raises(ConfigurationError, match="random_phase: an excitation of the shape recorded has no phase"):
        Scenario.load(str(path))


def test_missing_file_is_named() -> None:
    with pytest.raises(ConfigurationError, match="nowhere/mine.toml: no such file"):
        Scenario.load("nowhere/mine.toml")


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigurationError, match="no scenario is called 'thesys': there are .*thesis"):
        Scenario.load("thesys")


def test_enormous_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "huge.toml"
    path.write_bytes(b"#" * (config.MAX_FILE_BYTES + 1))
    with pytest.raises(ConfigurationError, match="larger than"):
        config.read_toml(path)


@pytest.mark.parametrize("kind", ["scenarios", "rigs", "devices"])
def test_shipped_files_are_valid(kind: config.Kind) -> None:
    names = config.names(kind)
    assert names
    for name in names:
        assert config.read_toml(config.locate(kind, name))


def test_every_shipped_scenario_loads_and_survives_a_round_trip() -> None:
    for name in config.names("scenarios"):
        scenario = Scenario.load(name)
        assert Scenario.from_table(scenario.as_table(), name) == scenario


def test_every_shipped_rig_opens() -> None:
    for name in config.names("rigs"):
        with open_rig(name) as rig:
            assert rig.description()["name"] == name


def test_channel_that_a_rig_does_not_name_has_the_whole_range(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("[card.range_v]\nforce = [0.0, 10.0]\n")
    with open_rig(str(path)) as rig:
        channels = rig.perform(Scenario.load("healthy"), 1).channels
    assert [channel.low_v for channel in channels.values()] == [0.0, -12.5, -12.5, -12.5]


def test_page_has_every_key_of_a_scenario_file() -> None:
    page = (Path(__file__).parents[2] / "harness/docs/howto/write-a-scenario.md").read_text(encoding="utf-8")
    shown = re.search(r"^```toml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert shown is not None
    Scenario.from_table(tomllib.loads(shown[1]), "page")
    tables = (Scenario, Excitation, PotChange, Expectations, Statement)
    keys = {(table.__name__, each.name) for table in tables for each in dataclasses.fields(table)}
    assert [key for key in sorted(keys) if not re.search(rf"\b{key[1]}\b", shown[1])] == []


@pytest.mark.parametrize("text", ["a\nb", "a\r\nb", "a\rb", 'three """ quotes', "back\\slash", "\u2028 \x7f \x00"])
def test_texts_come_back_from_toml_as_they_were(text: str) -> None:
    table = {"name": text, "within": [{"text": text}], "plain": "two\nlines"}
    assert tomllib.loads(config.to_toml(table)) == table


def test_text_that_no_file_holds_is_one_clear_line() -> None:
    with pytest.raises(ConfigurationError, match=r"TOML holds no text with '\\udc80'"):
        config.to_toml({"name": "half \udc80"})
