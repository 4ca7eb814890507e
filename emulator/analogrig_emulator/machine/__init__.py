"""The analogue computer: modes, pots, lamps, patching, and the programs that are shipped."""
