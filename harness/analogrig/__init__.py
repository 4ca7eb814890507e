"""The harness: plays a scenario on a rig, through a device, and judges what it says. README.md tells how."""
