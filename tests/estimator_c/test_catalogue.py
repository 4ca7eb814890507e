"""The message catalogue: what may never change, what it must cover, and what its hash is about."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import cantools
import pytest

from harness.catalogue import CATALOGUE_HASH, Change, Hello, Identify, Key, Trigger, pack, unpack

ESTIMATOR = Path(__file__).parents[2] / "estimator_c"
DBC = ESTIMATOR / "catalogue" / "analogrig.dbc"


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("analogrig_generate", ESTIMATOR / "catalogue" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def changed(text: str, old: str, new: str) -> cantools.database.can.Database:
    assert old in text
    database = cantools.database.load_string(text.replace(old, new), "dbc")
    assert isinstance(database, cantools.database.can.Database)
    return database


def test_introduction_never_changes_its_bytes() -> None:
    """These are the constants of all versions, so that two of different versions can at least tell each other so."""
    assert pack(Identify(seq=0x12)) == bytes.fromhex("30 12 00 00 00 00 00 00 00")
    assert unpack(bytes.fromhex("31 01 06 12 00 ef be ad de")) == Hello(1, 6, 0x12, 0xDEADBEEF)


def test_same_catalogue_gives_the_same_files(generate: ModuleType, tmp_path: Path) -> None:
    for name in ("first", "second"):
        assert generate.main([str(tmp_path / name), str(tmp_path / name / "tables.py")]) == 0
    first = {path.name: path.read_bytes() for path in (tmp_path / "first").iterdir()}
    assert first == {path.name: path.read_bytes() for path in (tmp_path / "second").iterdir()}
    assert sorted(first) == [
        "analogrig_catalogue.c",
        "analogrig_catalogue.h",
        "analogrig_codec.c",
        "analogrig_codec.h",
        "tables.py",
    ]
    assert not any(re.search(rb"20\d\d \d\d:|\d\d:\d\d:\d\d", text) for text in first.values())


def test_unchanged_file_is_left_alone(generate: ModuleType, tmp_path: Path) -> None:
    arguments = [str(tmp_path), str(tmp_path / "tables.py")]
    generate.main(arguments)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    generate.main(arguments)
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("BO_ 48 ", "BO_ 57 "),
        ("SG_ Force :", "SG_ Push :"),
        ("SG_ Force : 32|16@1+ (1,0)", "SG_ Force : 32|16@1+ (2,0)"),
        ("SG_ Force : 32|16@1+", "SG_ Force : 32|12@1+"),
        ('4 "REPORT_INTERVAL"', '9 "REPORT_INTERVAL"'),
        ('BA_ "FrameSeed" BO_ 49 1;', ""),
        ('[0|65535] "code"', '[0|65535] "mV"'),
    ],
)
def test_hash_sees_what_matters(generate: ModuleType, old: str, new: str) -> None:
    assert generate.catalogue_hash(changed(DBC.read_text(), old, new)) != CATALOGUE_HASH


def test_hash_does_not_see_comments(generate: ModuleType) -> None:
    text = DBC.read_text()
    assert generate.catalogue_hash(changed(text, "The plant has changed.", "Something is up.")) == CATALOGUE_HASH


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("BO_ 48 ", "BO_ 144 ", "identifier 0x90"),
        ("BO_ 48 Identify: 8 HARNESS\n SG_ Seq", "BO_ 48 Identify: 8 HARNESS\n SG_ Number", "byte 0 is not Seq"),
        ("SG_ Force : 32|16@1+", "SG_ Force : 33|15@1+", "no plain little-endian field"),
        ("SG_ Force : 32|16@1+ (1,0)", "SG_ Force : 32|16@1+ (0.5,0)", "no plain little-endian field"),
        ("SG_ Idle : 12|1@1+ (1,0)", "SG_ Idle : 12|1@1+ (2,0)", "Idle does not lie in one byte as a plain number"),
        ('VAL_ 53 Command 1 "START"', 'VAL_ 53 Command 1 "GO"', "another value table"),
    ],
)
def test_catalogue_that_breaks_a_rule_is_refused(generate: ModuleType, old: str, new: str, complaint: str) -> None:
    with pytest.raises(generate.CatalogueError, match=complaint):
        generate.check(changed(DBC.read_text(), old, new))


def declarations(struct: str, path: str = "core/est.h") -> set[str]:
    """The names of the fields of a struct of a header."""
    header = (ESTIMATOR / path).read_text()
    body = re.search(r"typedef struct \{([^{}]*)\} " + struct + ";", header)
    assert body is not None
    return set(re.findall(r"^\s+\w+\s+(\w+)(?:\[\w+\])?;", body[1], flags=re.MULTILINE))


def test_every_field_of_the_configuration_has_a_key() -> None:
    fields = declarations("est_config_t") | declarations("est_trigger_config_t")
    fields |= declarations("settings_t", "device/settings.h")
    keys = {key.name.lower() for key in Key}
    named_otherwise = {
        "c": {f"c{i}" for i in range(1, 9)},
        "kind": {"trigger"},
        "trigger": set[str](),
        "estimator": set[str](),
        "custom": set[str](),
    }
    assert keys == set().union(*(named_otherwise.get(name, {name}) for name in fields))


def test_changes_have_the_numbers_of_isolation() -> None:
    header = (ESTIMATOR / "isolation" / "est_isolation.h").read_text()
    numbers = dict(re.findall(r"EST_CHANGE_(\w+) += (\d+)", header))
    assert {change.name: change.value for change in Change} == {name: int(n) for name, n in numbers.items()}


def test_triggers_have_the_numbers_of_the_core() -> None:
    header = (ESTIMATOR / "core" / "est.h").read_text()
    numbers = dict(re.findall(r"EST_TRIGGER_(\w+) = (\d+)", header))
    assert {trigger.name: trigger.value for trigger in Trigger} | {"CUSTOM": 4} == {
        name: int(n) for name, n in numbers.items()
    }
