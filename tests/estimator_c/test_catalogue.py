"""The message catalogue: what may never change, what it must cover, and what its hash is about."""

from __future__ import annotations

import ctypes
import importlib.util
import math
import random
import re
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import cantools
import pytest
from cantools.database.can import Database, Message
from cantools.database.can.c_source import camel_to_snake_case
from cantools.database.can.signal import Signal

from analogrig.catalogue import (
    CATALOGUE_HASH,
    LAYOUTS,
    Alarm,
    Change,
    Configured,
    Diagnosis,
    Estimate,
    Hello,
    Identify,
    Key,
    SampleBlock,
    Stepped,
    Trigger,
    pack,
    unpack,
)
from analogrig.devices.library import LIBRARY

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


@pytest.fixture(scope="module")
def catalogue() -> Database:
    return changed(DBC.read_text(), "", "")


@pytest.fixture(scope="module")
def codec() -> ctypes.CDLL:
    """The generated C, as it is in the device of this process."""
    return ctypes.CDLL(str(LIBRARY))


def changed(text: str, old: str, new: str) -> Database:
    assert old in text
    database = cantools.database.load_string(text.replace(old, new), "dbc")
    assert isinstance(database, Database)
    return database


def signals(database: Database) -> Iterator[tuple[Message, Signal]]:
    for message in database.messages:
        for signal in message.signals:
            yield message, signal


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
        ("BO_ 48 ", "BO_ 127 "),
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
        ("SG_ Extent : 32|32@1- (1,0) [0|3.4028235E+38]", "SG_ Extent : 32|32@1- (1,0) [0|0]", "Extent has no range"),
        ("SG_ Samples : 8|4@1+ (1,0) [1|14]", "SG_ Samples : 8|4@1+ (1,0) [1|16]", "Samples cannot be 16"),
        ("SG_ Change : 8|8@1+ (1,0) [0|14]", "SG_ Change : 8|8@1+ (1,0) [0|13]", "Change cannot be 14"),
    ],
)
def test_catalogue_that_breaks_a_rule_is_refused(generate: ModuleType, old: str, new: str, complaint: str) -> None:
    with pytest.raises(generate.CatalogueError, match=complaint):
        generate.check(changed(DBC.read_text(), old, new))


def test_every_message_and_field_is_explained(catalogue: Database) -> None:
    """But for what the comment of the file says of all messages, and the later of numbered fields."""
    said = {"Seq", "Answers", *(f"{name}{i}" for name in ("Force", "Displacement") for i in range(1, 14))}
    assert [message.name for message in catalogue.messages if not message.comment] == []
    assert [
        f"{message.name}.{signal.name}"
        for message, signal in signals(catalogue)
        if not signal.comment and signal.name not in said
    ] == []


def test_every_message_goes_from_one_node_to_the_other(catalogue: Database) -> None:
    other = {"HARNESS": ["DEVICE"], "DEVICE": ["HARNESS"]}
    assert [node.name for node in catalogue.nodes] == list(other)
    assert all(signal.receivers == other[message.senders[0]] for message, signal in signals(catalogue))


def test_only_the_block_needs_can_fd(catalogue: Database) -> None:
    assert {message.name: message.length for message in catalogue.messages if message.is_fd} == {"SampleBlock": 64}
    assert {message.length for message in catalogue.messages if not message.is_fd} == {8}


def test_catalogue_survives_a_tool_that_saves_it(generate: ModuleType, catalogue: Database) -> None:
    saved = changed(catalogue.as_dbc_string(), "", "")
    generate.check(saved)
    assert generate.catalogue_hash(saved) == CATALOGUE_HASH


def test_python_codec_reads_what_cantools_writes(catalogue: Database) -> None:
    """Any payload of any message, field by field."""
    rng = random.Random(6)  # noqa: S311 - no secret
    for message in catalogue.messages * 20:
        values = {signal.name: any_value(signal, rng) for signal in message.signals}
        payload = message.encode(values, scaling=False, strict=False)
        ours = unpack(bytes([message.frame_id]) + payload)
        assert ours is not None
        assert pack(ours) == bytes([message.frame_id]) + payload
        fields = dict(zip(LAYOUTS[message.name].fields, flat(ours), strict=True))
        for shared, (first, n) in LAYOUTS[message.name].bits.items():
            fields[shared] = fields["flags"] >> first & (2**n - 1)
        assert {name: fields[camel_to_snake_case(name)] for name in values} == values


def any_value(signal: Signal, rng: random.Random) -> float:
    """One that float32 holds exactly, if it is a float."""
    return rng.randrange(-(2**24), 2**24) / 2**10 if signal.conversion.is_float else rng.getrandbits(signal.length)


def flat(message: tuple[Any, ...]) -> tuple[Any, ...]:
    return (*message[:-1], *message.codes) if isinstance(message, SampleBlock) else message


def test_c_codec_has_every_length_and_sender(codec: ctypes.CDLL, catalogue: Database) -> None:
    lengths = {message.frame_id: message.length for message in catalogue.messages}
    of_harness = {message.frame_id for message in catalogue.messages if message.senders == ["HARNESS"]}
    codec.analogrig_is_from_harness.restype = ctypes.c_bool
    assert [codec.analogrig_length(i) for i in range(256)] == [lengths.get(i, 0) for i in range(256)]
    assert {i for i in range(256) if codec.analogrig_is_from_harness(i)} == of_harness


def test_c_codec_finds_every_number_out_of_its_range(codec: ctypes.CDLL, catalogue: Database) -> None:
    for message, signal in signals(catalogue):
        name = f"analogrig_{camel_to_snake_case(message.name)}_{camel_to_snake_case(signal.name)}_is_in_range"
        is_in_range = codec[name]
        is_in_range.restype = ctypes.c_bool
        assert signal.minimum is not None
        assert signal.maximum is not None
        if signal.conversion.is_float:
            is_in_range.argtypes = [ctypes.c_float]
            assert not any(map(is_in_range, (math.nan, math.inf, -math.inf))), name
            assert is_in_range(signal.maximum), name
        else:
            is_in_range.argtypes = [ctypes.c_uint32]
            assert is_in_range(int(signal.minimum)), name
            assert is_in_range(int(signal.maximum)), name
            assert signal.maximum == 2**signal.length - 1 or not is_in_range(int(signal.maximum) + 1), name


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


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_number_that_is_none_is_no_message(value: float) -> None:
    for message in (
        Estimate(1, 2, 3, value),
        Stepped(1, 0, 3, value),
        Alarm(1, Trigger.CUSUM, 3, value),
        Diagnosis(1, Change.MASS, 3, value),
        Configured(1, Key.P0, 2, 0, value),
    ):
        assert unpack(pack(message)) is None
        assert unpack(pack(message)[:-4] + struct.pack("<f", 1.5)) is not None
