"""Export of the signals of a rig, without a device."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from analogrig.bench import Progress
from analogrig.errors import ConfigurationError
from analogrig.rigs.rig import Block, Rig
from analogrig.run import CHANNELS
from analogrig.scenario import Scenario
from analogrig.storage import replace_file


def write_signals(
    rig: Rig, scenario: Scenario, seed: int, path: Path, progress: Progress | None = None
) -> dict[str, Any]:
    """Play ``scenario`` on ``rig`` and write volts, codes and clipping flags, one row a sample, as .csv or .npz.

    :returns: ``samples``; ``clipped``, the number of samples with any channel clipped; ``overloads``, the first sample
        with a lit overload lamp by amplifier.
    :raises ConfigurationError: the suffix of ``path`` is neither .csv nor .npz.
    :raises RecordingError: the file cannot be written.
    """
    if path.suffix not in (".csv", ".npz"):
        raise ConfigurationError(f"{path}: the file's name must end with .csv or .npz")
    blocks: list[Block] = []
    performance = rig.perform(scenario, seed)
    for block in performance.blocks:
        blocks.append(block)
        if progress is not None:
            progress(block.first + len(block.codes), scenario.samples)
    with replace_file(path) as file:
        if path.suffix == ".csv":
            file.write(_csv(blocks).encode("ascii"))
        else:
            _save_npz(blocks, file)
    return {
        "samples": sum(len(block.codes) for block in blocks),
        "clipped": sum(int(block.clipped.any(axis=1).sum()) for block in blocks),
        "overloads": dict(performance.hindsight().lamps),
    }


def _csv(blocks: Sequence[Block]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    kinds = ("v", "code", "clipped")
    writer.writerow(["sample", *(f"{channel}_{kind}" for kind in kinds for channel in CHANNELS)])
    for block in blocks:
        rows = zip(block.volts.tolist(), block.codes.tolist(), block.clipped.astype(int).tolist(), strict=True)
        for index, (volts, codes, clipped) in enumerate(rows, start=block.first):
            writer.writerow([index, *(f"{v:.6f}" for v in volts), *codes, *clipped])
    return out.getvalue()


def _save_npz(blocks: Sequence[Block], file: BinaryIO) -> None:
    np.savez(
        file,
        channels=np.array(CHANNELS),
        volts=np.concatenate([block.volts for block in blocks]),
        codes=np.concatenate([block.codes for block in blocks]),
        clipped=np.concatenate([block.clipped for block in blocks]),
    )
