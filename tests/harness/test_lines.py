"""Firmwares that speak lines of text over a serial line."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.answers import Answers, Samples
from analogrig.bench import Bench
from analogrig.config import read_toml
from analogrig.devices.port import SerialDevice
from analogrig.devices.registry import describe, from_table, recorded, trusted
from analogrig.errors import ConfigurationError, LinkError, LinkTimeout
from analogrig.rigs.description import open_rig
from analogrig.run import Channel
from analogrig.scenario import Scenario
from analogrig.trust import Trust
from analogrig_lines.lines import LinesDevice, ProgramDevice
from analogrig_lines.templates import Reader, Writer, checksum_of
from tests.harness.processes import LONG_S
from tests.soak import line_faults
from tests.soak.line_faults import COMMON, EXPECTED, FLOODS, PROTOCOLS, N, Scripted, cases, check_clean, outcome

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "harness" / "examples" / "program"


@pytest.mark.parametrize(("protocol", "fault"), cases())
def test_fault_of_a_line_ends_as_documented(protocol: str, fault: str) -> None:
    for step in (N // 2,) if fault in FLOODS else (0, N // 2, line_faults.steps(fault)[-1]):
        assert outcome(protocol, fault, step)[0] == EXPECTED[protocol][fault]


@pytest.mark.parametrize(("fault", "kept"), [("hang-up", 4), ("silence", 5)])
def test_samples_before_a_failure_are_kept(fault: str, kept: int) -> None:
    device = Scripted.with_fault("plain", fault, 4)
    device.recover()
    answers: list[Answers] = []
    with pytest.raises(LinkError, match="sample"):
        answers.extend(line_faults.record(device))
    assert sum(map(len, answers)) == kept, "a sample of which the time-out has passed counts as lost"
    device.close()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_answers_of_a_firmware_belong_to_their_samples(protocol: str) -> None:
    check_clean(Scripted.with_fault(protocol))


def test_reset_line_is_repeated_while_a_board_starts_and_may_be_answered_twice() -> None:
    device = Scripted.with_fault("plain", "late start")
    for _ in range(3):
        check_clean(device)
    device.close()


def test_counters_of_the_line_name_the_faults() -> None:
    found = {}
    for fault in ("debug line", "twice back", "late back", "garbled back", "wrong digit"):
        device = Scripted.with_fault("checksum", fault, 4)
        device.recover()
        list(line_faults.record(device))
        found[fault] = dict(device.link_counters)
        device.close()
    assert found == {
        "debug line": {"lines_other": 1},
        "twice back": {"lines_repeated": 1},
        "late back": {"lines_late": 1},
        "garbled back": {"lines_other": 1},
        "wrong digit": {"lines_garbled": 1},
    }


@pytest.fixture
def port(tmp_path: Path) -> Iterator[str]:
    """Terminal behind which the example runs as a firmware would."""
    shutil.copytree(EXAMPLE, tmp_path, dirs_exist_ok=True)
    subprocess.run(["make", "--silent", f"ESTIMATOR={ROOT / 'estimator_c'}"], cwd=tmp_path, check=True)
    theirs, ours = os.openpty()
    tty.setraw(ours)
    with subprocess.Popen([tmp_path / "my_program"], stdin=theirs, stdout=theirs) as firmware:
        os.close(theirs)
        yield os.ttyname(ours)
        firmware.kill()
        os.close(ours)


def test_firmware_on_a_terminal_gives_the_estimates_of_every_device(port: str, tmp_path: Path) -> None:
    table = {key: value for key, value in read_toml(tmp_path / "my_program.toml").items() if key != "arguments"}
    description = from_table({**table, "kind": "lines", "name": "bob", "url": port, "timeout_s": LONG_S}, "bob")
    with open_rig("emulator") as rig, description.connect() as dut:
        bench = Bench(rig, dut)
        for _ in range(2):
            run = bench.play(Scenario.load("thesis"), seed=7)
            assert run.theta_hash().startswith("54f04f72e4f6d22a")
            assert not run.conditions.faults
        assert from_table({**recorded(dut.description()).as_table()}, "") == recorded(dut.description())


def test_silent_firmware_is_told_with_the_speed_of_the_line() -> None:
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    device = LinesDevice(name="bob", url=os.ttyname(theirs), baud=9600, timeout_s=0.05)
    nothing = np.zeros(4, np.uint16)
    with device.connect() as dut:
        dut.start()
        with pytest.raises(LinkTimeout) as raised:
            list(dut.play([Samples(0, nothing, nothing, np.ones(4, np.bool_))]))
    assert str(raised.value) == (
        "device bob: no answer to sample 0 within 0.05 s; no byte came; the line was opened at 9600 baud"
    )
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize("kind", [LinesDevice, SerialDevice])
def test_server_that_is_not_there_is_told_with_the_cure(kind: Any) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"socket://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(LinkError) as raised:
            kind(name="bob", url=url).open()
    assert str(raised.value) == f"device bob: cannot open {url}: Connection refused; start the server, or correct url"
    assert kind(name="bob", url=url).hint(url) == "the port may be serving another client"


def test_line_that_matches_no_template_is_told_with_the_template() -> None:
    device = Scripted.with_fault("plain")
    device._reader = Reader("receive", "{alarm:d}\n", lambda _: False, None)
    device.recover()
    with pytest.raises(LinkTimeout) as raised:
        list(line_faults.record(device))
    assert str(raised.value).endswith(
        r"; its last line '101,0' does not match receive = '{a1:g},{alarm:d}\n'; correct receive in the device file"
    )
    device.close()


# --------------------------------------------------------------------------------------------------------- templates

MINIMAL: dict[str, Any] = {"name": "bob", "url": "port"}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"send": "{u:d},{y:d}"}, r"send: must end with \\n or \\r"),
        ({"send": "{u:q}\n"}, r"send: the type of {u:q} must be one of d, x, g, a, f32, b"),
        ({"send": "{u}\n"}, r"send: '{' is neither {NAME:TYPE} nor two braces"),
        ({"send": "{v:d}\n"}, "send: has no field v"),
        ({"send": "{u:d},{u:d}\n"}, "send: the field u is there twice"),
        ({"send": "{u:d}{checksum:x}\n"}, "send: has a field checksum: set checksum, such as to CRC-16/MODBUS"),
        ({"send": "{checksum:x}{u:d}\n", "checksum": "xor"}, "send: no field may follow checksum"),
        ({"receive": "{a:g}{b:g}\n"}, "receive: nothing separates a from b"),
        ({"receive": "{a:g}\n{b:g}\n"}, "receive: must be one line"),
        ({"receive": "{alarm:g}\n"}, "receive: alarm must be a whole number, not of the type g"),
        ({"receive": "{alram:d}\n"}, "receive: field alram: did you mean 'alarm'? If it is an element of theta, state"),
        ({"receive": "x" * 5000}, "receive: longer than 4000 characters"),
        ({"theta": ["a1"]}, "theta: receive has no field a1"),
        ({"window": 2}, 'window: more than 1 sample in flight needs echo = "index"'),
        ({"window": 0}, "window must be 1 to 4096, not 0"),
        ({"echo": "index"}, "echo needs {index:d} in send and in receive"),
        ({"units": "volts"}, "send: volts need the type g, a or f32"),
        ({"reset_answer": "OK"}, "reset_answer needs reset"),
        ({"missing": "-\n", "send": "{u:d},{valid:d}\n"}, "missing: send has valid already"),
        ({"baud": 0}, "baud must be 1 to 100000000, not 0"),
        ({"settings": {"gain": 1.0}}, "settings: a device of the kind lines has none"),
        ({"receive": "{a1:g},{a2:g}\n", "datasheet": {"model": {"na": 1, "nb": 2}}}, "model has 3 parameters, theta 2"),
    ],
)
def test_wrong_template_is_refused_with_its_key(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        from_table({"kind": "lines", **MINIMAL, **changes}, "bob.toml")
    assert str(raised.value).startswith(f"bob.toml: {told.replace(chr(92) * 2, chr(92))}")


@pytest.mark.parametrize(
    ("template", "line", "values"),
    [
        ("{a:d},{b:g}\n", b"7, -1.5e3", [7, -1500]),
        ("{a:g},{b:g}\n", b".5,+2.", [0.5, 2]),
        ("{a:g},{b:g}\n", b"nan,-INF", [np.nan, -np.inf]),
        ("{a:g},{b:g}\n", b"nan(0x8),1e999", [np.nan, np.inf]),
        ("{a:a},{b:a}\n", b"0x1.8p+1,-0x0p+0", [3, 0]),
        ("{a:a},{b:a}\n", b"0x1p+99999,nan", [np.inf, np.nan]),
        ("{a:f32}{b:f32}\n", b"3f800000C0490fdb", [1, np.float32(-np.pi)]),
        ("{a:x} {b:x}\n", b"ff 0x10", [255, 16]),
        ('{{"a":{a:g},"s":"{s:s}","b":{b:d}}}\n', b'{"a":1,"s":"on","b":2}', [1, 2]),
        ("{a:g},{b:g}\n", b"1_0,2", None),
        ("{a:g},{b:g}\n", b"1,2,3", None),
        ("{a:g},{b:g}\n", b"1,", None),
        ("{a:d},{b:d}\n", b"0b1,2", None),
        ("{a:d},{b:d}\n", b"1" * 40 + b",2", None),
        ("{a:f32},{b:d}\n", b"3f80000,2", None),
        ("{a:g},{b:g}\n", b"\xb2,2", None),
    ],
)
def test_line_is_read_by_its_template(template: str, line: bytes, values: list[float] | None) -> None:
    reader = Reader("receive", template, lambda name: name == "s")
    words = reader.read(line)
    if values is None:
        assert words is None
    else:
        assert words is not None
        np.testing.assert_array_equal(reader.values([words], ["a", "b"]), [values])


def test_time_to_read_a_line_is_linear_in_its_length() -> None:
    reader = Reader("receive", ",".join(f"{{a{i}:g}}" for i in range(8)) + "\n", lambda _: False)

    def cpu_s(n: int) -> float:
        start_s = time.process_time()
        for line in (b"1" * n, b"1." * n, b"1e" * n, b" " * n, b"1," * n):
            assert reader.read(line) is None
        return time.process_time() - start_s

    assert min(cpu_s(400_000) for _ in range(3)) < 1.0  # quadratic: minutes


def test_checksums_are_those_of_their_standards() -> None:
    for name, check in (("xor", "31"), ("crc16", "29b1"), ("crc32", "cbf43926")):
        checksum = checksum_of(name)
        assert f"{checksum.compute(b'123456789'):0{checksum.digits}x}" == check


def test_lines_are_written_by_their_template() -> None:
    writer = Writer("send", '{{"u":{u:d},"y":{y:a}}} 5% {index:x}\n', ("u", "y", "index"))
    assert writer.contents([np.array([1, 2]), np.array([0.5, 0.1]), np.array([15, 16])], 2) == [
        b'{"u":1,"y":0x1.0000000000000p-1} 5% f\n',
        b'{"u":2,"y":0x1.999999999999ap-4} 5% 10\n',
    ]
    assert Writer("missing", "-\n", ()).contents([], 2) == [b"-\n", b"-\n"]


# -------------------------------------------------------------------------------------------------------- descriptions


def test_faults_that_the_protocol_leaves_unnoticed_are_listed() -> None:
    def cannot_tell(**changes: Any) -> tuple[str, ...]:
        return LinesDevice(**MINIMAL, **changes).known_datasheet().cannot_tell

    assert len(cannot_tell()) == 5
    assert cannot_tell(**COMMON, **PROTOCOLS["checksum"]) == ("a sample received twice if both answers are the same",)
    late = "an answer that is late by a whole cycle of its index"
    assert late in cannot_tell(**COMMON, **PROTOCOLS["echo"], indices=256)
    assert late not in cannot_tell(**COMMON, **PROTOCOLS["echo"])
    assert "a reset of the device during a record" not in cannot_tell(**PROTOCOLS["count"])
    assert (
        ProgramDevice(name="bob", arguments=("p",), reset="R\n", reset_answer="OK").known_datasheet().cannot_tell == ()
    )


def test_data_sheet_names_what_the_template_reports() -> None:
    sheet = LinesDevice(**MINIMAL, receive="{a1:g},{armed:d},{x:g},{statistic:g}\n", theta=("a1",)).known_datasheet()
    assert (sheet.theta_n, sheet.armed, sheet.statistic, sheet.innovation, sheet.alarms) == (
        1,
        True,
        True,
        False,
        False,
    )


@pytest.mark.parametrize(
    ("kind", "place", "option"),
    [("lines", 'url = "ttyX"', "./ttyX"), ("exec", 'arguments = ["./p", "-v"]', "./p")],
)
def test_file_that_names_a_port_or_a_program_needs_to_be_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, place: str, option: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(f'kind = "{kind}"\n{place}\n')
    with pytest.raises(ConfigurationError, match=f"no file may order: pass --allow {option}$"):
        trusted("mine.toml", Trust(option="--allow"))
    trusted("mine.toml", Trust([option]))
    trusted(f"{kind}:{option}", Trust())


def test_model_in_volts_is_converted_to_codes() -> None:
    """The same model y' = a y + b u + d, written in volts and in codes."""
    receive = "{a1:g},{b0:g},{d:g},{innovation:g},{alarm:d}\n"
    program = "for line in open(0): print('-0.5,0.25,3,1,0', flush=True)"
    sheet = {"model": {"na": 1, "nb": 1, "offset": True}}
    table = {"arguments": ["python3", "-c", program], "send": "{u:g} {y:g}\n", "units": "volts", "datasheet": sheet}
    description = from_table({"kind": "exec", "name": "bob", "receive": receive, "timeout_s": LONG_S, **table}, "bob")
    u, y = (
        Channel(low_v=low, lsb_v=lsb, unit="", unit_per_v=1.0, noise_lsb=0.0) for low, lsb in ((-5, 0.5), (-2, 0.1))
    )
    with description.connect() as device:
        device.prepare({"u": u, "y": y}, 1.0)
        device.start()
        zero = np.zeros(1, np.uint16)
        (answers,) = device.play([Samples(0, zero, zero, np.ones(1, np.bool_))])
    assert answers.theta is not None
    assert answers.innovation is not None
    a1, b0, d = answers.theta[0].tolist()
    for u_code, y_code in ((0, 0), (7, 13)):
        in_volts = 0.5 * y.volts(np.array([y_code]))[0] + 0.25 * u.volts(np.array([u_code]))[0] + 3
        assert y.volts(np.array([0]))[0] + y.lsb_v * (-a1 * y_code + b0 * u_code + d) == pytest.approx(in_volts)
    assert answers.innovation.tolist() == pytest.approx([10.0])


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("serial:/dev/ttyX?exchange=stream", {"url": "/dev/ttyX", "exchange": "stream"}),
        ("serial:/dev/ttyX?exchange=block&baud=9600", {"url": "/dev/ttyX", "exchange": "block", "baud": 9600}),
        ("serial:/dev/ttyX?window=8&timeout_s=2", {"url": "/dev/ttyX", "window": 8, "timeout_s": 2}),
        ("serial:/dev/ttyX?computes=own&most_lost_n=3", {"url": "/dev/ttyX", "computes": "own", "most_lost_n": 3}),
        ("serial:/dev/ttyX?report_interval_n=10", {"url": "/dev/ttyX", "report_interval_n": 10}),
        ("serial:/dev/ttyX?wire_faults=flip@0.1", {"url": "/dev/ttyX", "wire_faults": "flip@0.1"}),
        ("serial:/dev/ttyX?alarm_is=level", {"url": "/dev/ttyX", "alarm_is": "level"}),
        ("serial:socket://h:1?exchange=stream", {"url": "socket://h:1", "exchange": "stream"}),
        ("serial:socket://h:1?logging=debug", {"url": "socket://h:1?logging=debug", "exchange": "sample"}),
        (
            "serial:rfc2217://h:1?ign_set_control&exchange=stream&timeout=3",
            {"url": "rfc2217://h:1?ign_set_control&timeout=3", "exchange": "stream"},
        ),
        ("lines:spy:///dev/ttyX?file=log&prompt=%3E", {"url": "spy:///dev/ttyX?file=log", "prompt": ">"}),
        ("frames:socket://h:1?framing=slip&baud=9600", {"url": "socket://h:1", "framing": "slip", "baud": 9600}),
        ("lines:/dev/ttyX?send=%7Bu%3Ad%7D%0A", {"url": "/dev/ttyX", "send": "{u:d}\n"}),
    ],
)
def test_name_of_a_port_takes_fields_of_the_device_and_parameters_of_the_url(name: str, fields: dict[str, Any]) -> None:
    described = describe(name)
    assert {key: getattr(described, key) for key in fields} == fields
    assert described.name == name


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("serial:/dev/ttyX?exchnage=stream", "unknown key 'exchnage' (known: name, description"),
        ("serial:socket://h:1?exchnage=stream", "unknown key 'exchnage': did you mean 'exchange'?"),
        ("serial:/dev/ttyX?exchange=streams", "exchange: must be one of 'sample', 'block', 'stream', not 'streams'"),
        ("serial:/dev/ttyX?exchange", "'exchange' is not KEY=VALUE"),
        ("serial:?exchange=stream", "no port: use serial:/dev/ttyACM0"),
        ("serial:", "no port: use serial:/dev/ttyACM0"),
        ("frames:", "no port: use frames:/dev/ttyACM0"),
        ("serial:/dev/ttyX?window=0", "window must be 1 to 255, not 0"),
        ("frames:/dev/ttyX?framing=hdlc", "framing: must be one of 'lines', 'cobs', 'slip'"),
    ],
)
def test_wrong_name_of_a_port_is_one_line_with_the_key(name: str, told: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        describe(name)
    assert told in str(raised.value)


FRAMES = {"kind": "frames", "name": "bob", "url": "port"}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"framing": "length", "delimiter": "0d"}, "delimiter: for framing = 'delimiter', not 'length'"),
        ({"header": "aa"}, "header: for framing = 'length' or 'delimiter' or 'none', not 'cobs'"),
        ({"framing": "delimiter"}, "delimiter: framing = 'delimiter' needs one, such as '0d'"),
        ({"framing": "none", "header": "a"}, "header: bytes are pairs of hexadecimal digits, such as 'aa 55', not 'a'"),
        ({"framing": "lines"}, "framing: binary records may contain line ends"),
        ({"kind": "lines", "framing": "none"}, "framing: text needs a framing: lines, cobs"),
        ({"prompt": ">"}, "prompt: only a device that sends lines of text has one"),
        ({"checksum": "CRC-16"}, "checksum: CRC-16 is the name of several: CRC-16/ARC"),
        ({"checksum": "CRC-9/NONE", "receive": "{alarm:u8}{checksum:u16}"}, "checksum: unknown 'CRC-9/NONE'"),
        ({"receive": "{alarm:u8}{checksum:u16}"}, "receive: has a field checksum: set checksum, such as to CRC-16"),
        (
            {"checksum": "crc32", "receive": "{alarm:u8}{checksum:u16}"},
            "receive: the checksum has 32 bits: use the type u32 or u32be",
        ),
        ({"checksum": "xor", "receive": "{checksum:u8}{alarm:u8}"}, "receive: nothing may follow checksum"),
        ({"receive": "{alarm:f32}"}, "receive: alarm must be a whole number, not of the type f32"),
        ({"receive": "xyz{alarm:u8}"}, "receive: bytes are pairs of hexadecimal digits"),
        ({"receive": "0a"}, "receive: a record needs fields"),
        ({"send": "{u:u16}{w:u16}"}, "send: has no field w"),
        ({"units": "volts"}, "send: volts need the type f32 or f64"),
        ({"reset": "R"}, "reset: bytes are pairs of hexadecimal digits"),
        ({"alarm_is": []}, 'alarm_is must be "event", "level", or an array of the states'),
        (
            {"send": "{index:u8}{u:u16}", "receive": "{index:u8}{alarm:u8}", "echo": "index", "window": 256},
            "window must be less than 256, the range of the index, not 256",
        ),
    ],
)
def test_wrong_frame_is_refused_with_its_key(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        from_table({**FRAMES, **changes}, "bob.toml")
    assert told in str(raised.value)


@pytest.mark.parametrize(
    ("name", "check"),
    [
        ("CRC-16/MODBUS", 0x4B37),
        ("CRC-16/ARC", 0xBB3D),
        ("crc-16/xmodem", 0x31C3),
        ("CRC-16/CCITT-FALSE", 0x29B1),
        ("CRC16-KERMIT", 0x2189),
        ("CRC-16/X-25", 0x906E),
        ("CRC-8", 0xF4),
        ("CRC-8/MAXIM", 0xA1),
        ("CRC-8/SAE-J1850", 0x4B),
        ("CRC_8/AUTOSAR", 0xDF),
        ("CRC-32", 0xCBF43926),
        ("CRC-32/MPEG-2", 0x0376E6E7),
        ("CRC-32C", 0xE3069283),
    ],
)
def test_crc_has_the_check_value_of_the_catalogue_of_crcs(name: str, check: int) -> None:
    assert checksum_of(name).compute(b"123456789") == check
