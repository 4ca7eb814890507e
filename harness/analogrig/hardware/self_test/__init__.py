"""The self-test of a rig: what is wrong with it, before any device is judged by it."""
