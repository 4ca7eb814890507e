"""Page of the live bench in a real browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from analogrig import cli
from analogrig.program import Program
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_live.bench_server import BenchServer
from analogrig_live.commands import Restart, SetPlaying, Step
from tests.browser import COUNT_PIXELS, Watched
from tests.harness.live.benches import LiveBench, benched, linked
from tests.served.serving import serving

expect.set_options(timeout=600_000)

TOKEN = "again"  # noqa: S105 - of a server that lives for one test
K = '[data-parameter="K"]'


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[BenchServer]:
    with LiveBench(tmp_path) as server:
        yield server


@pytest.fixture
def opened(browser: Browser, bench: BenchServer) -> Iterator[Watched]:
    watched = opened_at(browser, bench)
    yield watched
    watched.page.close()


COUNT_IN_LINE = """(canvas, [r, g, b, height]) => {
    const { width } = canvas;
    const { data } = canvas.getContext("2d").getImageData(0, Math.round(height * canvas.height) - 2, width, 5);
    let count = 0;
    for (let i = 0; i < data.length; i += 4) count += data[i] === r && data[i + 1] === g && data[i + 2] === b;
    return count;
}"""
"""Number of pixels of a colour about a horizontal line."""


def opened_at(browser: Browser, bench: Any) -> Watched:
    """Page of anything with an address."""
    watched = Watched(browser, bench.address)
    watched.page.set_default_timeout(600_000)
    watched.page.wait_for_selector("html[data-connected][data-role]")
    return watched


def wait_for_frames(page: Page, count: int) -> None:
    page.wait_for_function("(count) => Number(document.documentElement.dataset.frames ?? 0) >= count", arg=count)


def drag_by_touch(page: Page, x: float, start_y: float, end_y: float) -> None:
    session = page.context.new_cdp_session(page)
    for kind, y in (("touchStart", start_y), ("touchMove", end_y - 1.0), ("touchMove", end_y), ("touchEnd", None)):
        points = [] if y is None else [{"x": x, "y": y}]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def frames_of(page: Page) -> int:
    return int(page.evaluate("Number(document.documentElement.dataset.frames ?? 0)"))


def test_scope_moves_without_a_fault_or_a_request_elsewhere(opened: Watched, bench: BenchServer) -> None:
    """Light and dark, wide and narrow, by axe-core."""
    wait_for_frames(opened.page, frames_of(opened.page) + 5)
    assert opened.page.locator("#curves").evaluate(COUNT_PIXELS, [0, 114, 178]) > 100
    expect(opened.page.locator("#triggered")).to_have_text("triggered")
    expect(opened.page.locator('tr[data-signal="force"]')).to_contain_text("200 Hz")
    named = opened.page.locator("select:visible, [role=group]:visible")
    names = named.evaluate_all("all => all.map((each) => each.ariaLabel ?? each.labels[0]?.firstChild.data.trim())")
    assert len(set(names)) == len(names)
    assert opened.requests == [bench.address]
    assert opened.faults() == []


def test_pot_turned_by_the_keyboard_raises_an_alarm_within_twice_its_bound(opened: Watched, bench: BenchServer) -> None:
    session, page = bench.session, opened.page
    for command in (SetPlaying(on=False), Restart(), Step(1700)):
        session.do(command)
    expect(page.locator("#clock")).to_contain_text("take 2, 85 ms, 1700 samples")
    page.locator(K).press("PageDown")
    expect(page.locator(K)).to_have_attribute("aria-valuetext", re.compile("^K 22180"))
    page.wait_for_function("() => document.getElementById('play').textContent === 'Run'")
    session.do(Step(300))
    expect(page.locator("#clock")).to_contain_text("2000 samples")
    row = page.locator("#alarms tbody tr").first
    expect(row).to_contain_text("K")
    expect(row.locator("td").nth(4)).not_to_have_text("–")
    take, sample, change, latency, bound = row.locator("td").all_inner_texts()
    assert (take, change) == ("2", "K")
    assert int(sample) == 1699 + int(latency)
    assert 0 < int(latency) <= 2 * int(bound)
    expect(page.locator("#alarm")).to_contain_text(f"K changed {latency} samples before, best possible {bound}")
    curves, axes = (page.locator(each).bounding_box() for each in ("#curves", ".u-over"))
    assert curves is not None
    assert curves == pytest.approx(axes, abs=0.5)


def test_recording_made_on_the_page_replays_with_the_same_alarms(
    opened: Watched, bench: BenchServer, tmp_path: Path
) -> None:
    page = opened.page
    page.get_by_role("button", name="Record").click()
    expect(page.get_by_role("button", name="End the recording")).to_be_visible()
    for refused in ("#restart", "#generator-on", "[data-key=shape]", "[data-mode=HOLD]"):
        expect(page.locator(refused)).to_be_disabled()
    page.wait_for_function(
        "() => Number(document.getElementById('clock').textContent.match(/(\\d+) samples/)[1]) > 2000"
    )
    page.locator(K).press("PageDown")
    expect(page.locator("#alarms tbody tr").first).to_contain_text("K")
    page.get_by_role("button", name="End the recording").click()
    expect(page.locator("#notices")).to_contain_text("analogrig replay")
    (saved,) = bench.session.saved
    expect(page.locator("#replay")).to_have_text(f"analogrig replay {saved.run}")
    expect(page.locator("#rerun")).to_have_text(f"analogrig run --scenario {saved.scenario}")
    expect(page.locator("#alarm")).to_contain_text("no alarm in this take (last one: take 2, sample")
    page.locator("#copy-replay").click()
    expect(page.locator("#copy-replay")).to_have_text("Copied")
    assert page.evaluate("getSelection().toString()") == f"analogrig replay {saved.run}"
    page.get_by_role("button", name="Close").click()
    expect(page.locator("#saved")).to_be_hidden()
    recorded = Run.load(saved.run)
    assert len(recorded.alarm_index) >= 1
    cli.main(["replay", str(saved.run), "--out", str(tmp_path / "again")])
    assert Run.load(tmp_path / "again" / "run.npz").alarm_index.tolist() == recorded.alarm_index.tolist()
    assert opened.complaints == []


def test_pots_turn_by_wheel_drag_and_number(opened: Watched, bench: BenchServer) -> None:
    page, values = opened.page, bench.session.values
    knob = page.locator(K)
    page.locator(".knob").filter(has=knob).locator("input").fill("20000")
    page.keyboard.press("Enter")
    expect(knob).to_have_attribute("aria-valuenow", "20000")
    knob.hover()
    page.mouse.wheel(0, 100)
    expect(knob).to_have_attribute("aria-valuetext", "K 19802 N/m")
    box = knob.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 40, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 40, box["y"] + 60, steps=4)
    page.mouse.up()
    expect(knob).to_have_attribute("aria-valuetext", re.compile("^K 18"))
    before = values["K"]
    drag_by_touch(page, box["x"] + 40, box["y"] + 40, box["y"] + 60)
    page.wait_for_function("(most) => document.querySelector('[data-parameter=K]').ariaValueNow < most", arg=before)
    page.wait_for_function("() => document.querySelector('#felt').textContent !== '–'")
    assert values["K"] < 19802
    trouble = page.locator("#trouble")
    page.locator(".knob").filter(has=knob).locator("input").fill("1e9")
    page.keyboard.press("Enter")
    expect(knob).to_have_attribute("aria-valuenow", "29000")
    expect(trouble).to_have_text("K: limited to 15000 … 29000 N/m")
    page.get_by_label("Frequency").fill("1e9")
    page.keyboard.press("Enter")
    expect(trouble).to_contain_text("Frequency")
    expect(trouble).not_to_contain_text("frequency_hz")
    page.locator(".knob").filter(has=knob).locator("input").fill("28000")
    page.keyboard.press("Enter")
    expect(trouble).to_be_empty()


def test_modes_faults_generator_and_probes_are_at_hand(opened: Watched, bench: BenchServer) -> None:
    page = opened.page
    page.get_by_role("button", name="hold", exact=True).click()
    expect(page.get_by_role("button", name="hold", exact=True)).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="operate", exact=True).click()
    page.get_by_role("button", name="channel displacement stuck").click()
    expect(page.get_by_role("button", name="channel displacement stuck")).to_have_attribute("aria-pressed", "true")
    assert bench.session.injected == {"stuck"}
    page.get_by_label("Frequency").fill("100")
    page.keyboard.press("Enter")
    expect(page.locator('tr[data-signal="force"]')).to_contain_text("100 Hz")
    page.get_by_role("button", name="probe U3").click()
    expect(page.locator('tr[data-signal="U3"]')).to_be_visible()
    page.get_by_role("button", name="probe U2").press("Enter")
    expect(page.locator('tr[data-signal="U2"] .number').first).not_to_have_text("–")
    page.get_by_role("button", name="Switch off").click()
    expect(page.locator("#role")).to_contain_text("generator is off")
    assert opened.complaints == []


def test_trigger_that_does_not_come_is_told_and_shown_at_once(opened: Watched) -> None:
    page, told = opened.page, opened.page.locator("#triggered")
    colour = [204, 121, 167]  # of the displacement, whose values end at 6 V
    page.locator("#source").select_option("displacement")
    page.locator("#mode").select_option("normal")
    page.locator("#level").fill("8")
    page.keyboard.press("Enter")
    expect(told).to_have_text("waiting for a trigger: the level is above all values of displacement")
    assert page.locator("#curves").evaluate(COUNT_IN_LINE, [*colour, 0.1]) > 50  # 8 V of -10 to 10
    page.locator("#mode").select_option("single")
    expect(told).to_have_text("armed: the level is above all values of displacement")
    page.locator("#level").fill("3")
    page.keyboard.press("Enter")
    expect(told).to_have_text("stopped after a single shot")
    page.locator("#mode").select_option("auto")
    expect(told).to_have_text("triggered")
    page.get_by_role("button", name="Pause").click()
    expect(told).to_have_text("newest samples, the last one at the right")
    assert opened.complaints == []


def test_spectrum_xy_persistence_and_cursors(opened: Watched) -> None:
    page = opened.page
    page.get_by_role("checkbox", name="persistence").check()
    page.get_by_role("checkbox", name="cursors").check()
    expect(page.locator("#cursor-text")).to_contain_text(re.compile("B − A: .*1/Δt"))
    page.get_by_label("Display").select_option("fft")
    expect(page.locator("#cursor-text")).to_contain_text("dB")
    page.get_by_label("Display").select_option("xy")
    expect(page.locator("#xy")).to_be_visible()
    wait_for_frames(page, frames_of(page) + 3)
    painted = page.evaluate(
        "() => { const c = document.getElementById('xy'); const d = c.getContext('2d')"
        ".getImageData(0, 0, c.width, c.height).data; let n = 0;"
        " for (let i = 0; i < d.length; i += 4) n += d[i + 3] > 0; return n; }"
    )
    assert painted > 1000
    page.get_by_label("Units").select_option("problem")
    expect(page.locator('tr[data-signal="displacement"] td').first).to_have_text("m")
    page.get_by_label("Display").select_option("yt")
    expect(page.get_by_label("force: per division")).to_have_value("500")  # N
    assert opened.complaints == []


def test_second_page_watches_and_drives_when_the_first_is_closed(browser: Browser, bench: BenchServer) -> None:
    first, second = opened_at(browser, bench), opened_at(browser, bench)
    expect(second.page.locator("#role")).to_have_text("This page watches: another one drives.")
    expect(second.page.get_by_role("button", name="Record")).to_be_disabled()
    first.page.locator(K).press("PageDown")
    expect(second.page.locator(K)).to_have_attribute("aria-valuetext", re.compile("^K 22180"))
    first.page.close()
    expect(second.page.locator("#role")).to_contain_text("Nobody drives")
    second.page.get_by_role("button", name="Drive").click()
    expect(second.page.locator("#role")).to_contain_text("The generator is off")
    second.page.get_by_role("button", name="Switch on").click()
    expect(second.page.locator("#role")).to_have_text("This page drives the bench.")
    assert second.complaints == []
    second.page.close()


def test_page_connects_again_when_the_server_has_been_restarted(browser: Browser, tmp_path: Path) -> None:
    with LiveBench(tmp_path, token=TOKEN) as server:
        watched = opened_at(browser, server)
        port = int(server.address.split(":")[2].partition("/")[0])
    page = watched.page
    page.wait_for_selector("html:not([data-connected])")
    expect(page.locator("#trouble")).to_contain_text("does not answer")
    with LiveBench(tmp_path, token=TOKEN, port=port):
        page.wait_for_selector("html[data-connected]")
        wait_for_frames(page, frames_of(page) + 3)
        expect(page.locator("#trouble")).to_be_empty()
        page.close()


def test_page_drives_a_served_instrument_in_another_process(browser: Browser, tmp_path: Path) -> None:
    with serving() as served:
        rig = f"{served.rigs_file(tmp_path)}:bench"
        with benched("--rig", rig, "--allow", served.address, folder=tmp_path / "out") as bench:
            watched = opened_at(browser, bench)
            page = watched.page
            page.get_by_role("button", name="Switch on").click()
            wait_for_frames(page, 1)
            page.locator(K).press("PageDown")
            expect(page.locator("#alarms")).to_contain_text("K")
            assert watched.complaints == []
            page.close()


def test_page_without_a_connection_operates_nothing(browser: Browser, bench: BenchServer) -> None:
    watched = Watched(browser, "about:blank")
    watched.page.route_web_socket("**/live*", lambda socket: socket.close())
    watched.page.goto(bench.address)
    expect(watched.page.locator("#role")).to_have_text("The bench is not connected.")
    expect(watched.page.locator("#record")).to_be_disabled()
    for control, chosen in (("#kind", "fft"), ("#units", "problem"), ("#slope", "falling")):
        watched.page.select_option(control, chosen)
    assert watched.complaints == []


def test_cut_line_is_reported_and_mended(browser: Browser, tmp_path: Path) -> None:
    with LiveBench(tmp_path, device=linked) as server:
        watched = opened_at(browser, server)
        page = watched.page
        page.locator("#line-fault").select_option("disconnect")
        page.get_by_role("button", name="Inject into the next frame").click()
        expect(page.locator("#failure")).to_contain_text("the line is cut")
        expect(page.locator("#failure")).to_contain_text("Mend the line, then press Run.")
        expect(page.locator("#line-faults")).to_have_text("in force: disconnect")
        page.get_by_role("button", name="Mend the line").click()
        expect(page.locator("#line-faults")).to_be_empty()
        page.get_by_role("button", name="Run", exact=True).click()
        expect(page.locator("#clock")).to_contain_text("take 2, ")
        expect(page.locator("#failure")).to_be_empty()
        expect(page.locator("#frames")).not_to_have_text("–")
        assert watched.complaints == []
        page.close()


@pytest.mark.parametrize("program", ["dc-motor", "pendulum"])
def test_programs_without_estimates_open_without_a_complaint(browser: Browser, tmp_path: Path, program: str) -> None:
    with LiveBench(tmp_path, scenario=Scenario.of_program(Program.load(program))) as server:
        watched = opened_at(browser, server)
        wait_for_frames(watched.page, 2)
        assert watched.page.get_by_role("slider").count() >= len(server.session.knobs) > 0
        assert watched.complaints == []
        watched.page.close()
