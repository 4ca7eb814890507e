"""SocketCAN for machines whose kernel has none: a guest under QEMU, and the tests that run in it (README.md)."""
