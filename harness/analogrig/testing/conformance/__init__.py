"""The contract of a device as tests, to run against yours before you trust its verdicts.

    pytest --pyargs analogrig.testing.conformance --hil-dut mykind:x

A test that the device cannot take is skipped with the reason. ``--hil-time-limit`` bounds each play, 60 s by default.
"""
