"""Measured data of other tools as recordings: CSV, LabVIEW, NumPy, MATLAB, MF4, Parquet, WAV; ``analogrig import``."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig_imports.imported import ImportDescription, ImportedColumn, import_columns
else:
    from analogrig.lazy import loader

    __getattr__ = loader(__name__, {"analogrig_imports.imported": "ImportDescription ImportedColumn import_columns"})

__all__ = ["ImportDescription", "ImportedColumn", "import_columns"]
