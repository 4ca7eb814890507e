"""Guest under QEMU with SocketCAN, for machines whose kernel has none, and the tests that run in it (README.md)."""
