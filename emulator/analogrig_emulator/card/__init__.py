"""The generator and the data-acquisition card."""
