"""Layout of a patch: blocks in columns by the flow of signals, wires that are horizontal and vertical.

Each wire has its own vertical track in every channel between two columns, and its own lane below the blocks if it skips
a column or leads back. Wires cross, but never run on top of each other: the rows of neighbouring columns are displaced
by STAGGER.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

ROW = 34
"""Distance of two pins, and height of the label below a block."""
STAGGER = 6
BLOCK_WIDTH = 176
"""Width of a block with the pots at its pins."""
_MOST_COLUMNS = 5
"""Longer chains go on below, at the first column of elements."""
_TRACK, _LANE, _MARGIN, _TOP = 11, 11, 16, 70


class Point(NamedTuple):
    """Place in the drawing, in pixels."""

    x: float
    y: float


@dataclass(frozen=True)
class Box:
    """Block with its output node, and the nodes at its pins; one without pins is a source."""

    node: str
    pins: tuple[str, ...] = ()

    @property
    def height(self) -> int:
        return ROW * max(1, len(self.pins))


@dataclass(frozen=True)
class WirePath:
    """Wire of a node: lines, and the points where three of them meet."""

    lines: tuple[tuple[Point, Point], ...]
    joints: tuple[Point, ...]


@dataclass(frozen=True)
class PatchLayout:
    """Places of the upper left corners of all blocks, in their order, and wires by node."""

    places: tuple[Point, ...]
    wires: Mapping[str, WirePath]
    width: float
    height: float


def lay_out(blocks: Sequence[Box]) -> PatchLayout:
    """Layout of blocks; every node at a pin is the output of one of them."""
    columns = _columns(blocks)
    users = _users(blocks)
    column_of = {i: c for c, column in enumerate(columns) for i in column}
    nets = [_nets_of_channel(blocks, users, column_of, channel) for channel in range(len(columns) + 1)]
    places: dict[int, Point] = {}
    tracks: dict[tuple[str, int], float] = {}
    x, highest = float(_MARGIN), max(sum(blocks[i].height + ROW for i in column) for column in columns)
    for c, column in enumerate(columns):
        for k, node in enumerate(nets[c]):
            tracks[node, c] = x + (k + 0.5) * _TRACK
        x += len(nets[c]) * _TRACK + _TRACK
        free = highest - sum(blocks[i].height + ROW for i in column)
        y = _TOP + free // (2 * ROW) * ROW + c * STAGGER
        for i in column:
            places[i] = Point(x, y)
            y += blocks[i].height + ROW
        x += BLOCK_WIDTH + _TRACK
    for k, node in enumerate(nets[-1]):
        tracks[node, len(columns)] = x + (k + 0.5) * _TRACK
    wires, lanes = {}, 0
    for i, block in enumerate(blocks):
        start = column_of[i] + 1
        ends: dict[int, list[Point]] = {start: [Point(places[i].x + BLOCK_WIDTH, places[i].y + block.height / 2)]}
        for user, pin in users.get(block.node, ()):
            end = Point(places[user].x, places[user].y + (pin + 0.5) * ROW)
            ends.setdefault(column_of[user], []).append(end)
        lane = _TOP + highest + _MOST_COLUMNS * STAGGER + lanes * _LANE if len(ends) > 1 else None
        lanes += lane is not None
        if users.get(block.node):
            wires[block.node] = _wire(ends, {c: tracks[block.node, c] for c in ends}, lane)
    width = x + len(nets[-1]) * _TRACK + _MARGIN
    height = _TOP + highest + _MOST_COLUMNS * STAGGER + lanes * _LANE + _MARGIN
    return PatchLayout(tuple(places[i] for i in range(len(blocks))), wires, width, height)


def _users(blocks: Sequence[Box]) -> dict[str, list[tuple[int, int]]]:
    """Blocks and pins at which each node is used."""
    users: dict[str, list[tuple[int, int]]] = {}
    for i, block in enumerate(blocks):
        for pin, node in enumerate(block.pins):
            users.setdefault(node, []).append((i, pin))
    return users


def _nets_of_channel(
    blocks: Sequence[Box],
    users: Mapping[str, Sequence[tuple[int, int]]],
    column_of: Mapping[int, int],
    channel: int,
) -> list[str]:
    """Nodes with a track in the channel before a column."""
    return [
        block.node
        for i, block in enumerate(blocks)
        if (pins := users.get(block.node)) and channel in (column_of[i] + 1, *(column_of[user] for user, _ in pins))
    ]


def _columns(blocks: Sequence[Box]) -> list[list[int]]:
    """Blocks by column: each right of the blocks that feed it, loops cut where a search first closes them."""
    producer = {block.node: i for i, block in enumerate(blocks)}
    feeds = [[producer[node] for node in block.pins] for block in blocks]
    fed: list[list[int]] = [[] for _ in blocks]
    for i, sources in enumerate(feeds):
        for source in sources:
            fed[source].append(i)
    back = _closing(fed, sorted(range(len(blocks)), key=lambda i: len(feeds[i]) > 0))
    depth: dict[int, int] = {}

    def deep(i: int) -> int:
        if i not in depth:
            ahead = [deep(source) for source in feeds[i] if (source, i) not in back]
            depth[i] = 1 + max(ahead) if ahead else int(bool(feeds[i]))
        return depth[i]

    steps: list[list[int]] = [[] for _ in range(1 + max(map(deep, range(len(blocks))), default=0))]
    for i in range(len(blocks)):
        steps[depth[i]].append(i)
    columns: list[list[int]] = [[] for _ in range(_MOST_COLUMNS + 1)]
    for number, step in enumerate(_ordered(steps, feeds)):
        columns[1 + (number - 1) % _MOST_COLUMNS if number else 0] += step
    return [column for column in columns if column]


def _closing(fed: Sequence[Sequence[int]], starts: Iterable[int]) -> set[tuple[int, int]]:
    """Connections that close a loop, found by a search in depth from each start."""
    found: set[tuple[int, int]] = set()
    done: set[int] = set()
    for start in starts:
        path, ahead = [start], [iter(fed[start] if start not in done else ())]
        while path:
            following = next(ahead[-1], None)
            if following is None:
                done.add(path.pop())
                ahead.pop()
            elif following in path:
                found.add((path[-1], following))
            elif following not in done:
                path.append(following)
                ahead.append(iter(fed[following]))
    return found


def _ordered(columns: Sequence[Sequence[int]], feeds: Sequence[Sequence[int]]) -> list[list[int]]:
    """Columns whose blocks stand at the mean height of those that feed them from the left."""
    height: dict[int, float] = {}
    out: list[list[int]] = []
    for column in columns:
        wanted = {}
        for place, i in enumerate(column):
            known = [height[source] for source in feeds[i] if source in height]
            wanted[i] = sum(known) / len(known) if known else float(place)
        out.append(sorted(column, key=lambda i: (wanted[i], i)))
        height |= {i: float(place) for place, i in enumerate(out[-1])}
    return out


def _wire(ends: Mapping[int, Sequence[Point]], tracks: Mapping[int, float], lane: float | None) -> WirePath:
    """Wire from its ends by channel over a vertical track in each, and the lane that joins them."""
    lines: list[tuple[Point, Point]] = []
    joints: list[Point] = []
    for channel, points in ends.items():
        x = tracks[channel]
        heights = sorted({point.y for point in points} | ({lane} if lane is not None else set()))
        lines += [(Point(x, point.y), point) for point in points]
        if len(heights) > 1:
            lines.append((Point(x, heights[0]), Point(x, heights[-1])))
        sides = [point.y for point in points]
        joints += [Point(x, y) for y in heights if y not in (heights[0], heights[-1]) or sides.count(y) > 1]
    if lane is not None:
        across = sorted(tracks.values())
        lines.append((Point(across[0], lane), Point(across[-1], lane)))
        joints += [Point(x, lane) for x in across[1:-1]]
    return WirePath(tuple(lines), tuple(joints))
