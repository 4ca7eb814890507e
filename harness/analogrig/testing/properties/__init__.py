"""The properties that any estimator behind the catalogue's messages should have, as tests to run against yours.

    pytest --pyargs analogrig.testing.properties --hil-dut serial:/dev/ttyACM0 --hil-profile nightly

What fails is shrunk to the simplest scenario that still fails, and left as files (see --hil-runs-dir). How seldom a
sound device fails one is derived in harness/docs/background/properties.md.
"""
