"""Commands on rigs: doctor, calibrate, compare-rigs, serve."""
