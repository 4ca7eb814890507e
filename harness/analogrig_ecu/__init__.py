"""ECUs on a CAN bus with messages of their own, which a DBC and a device file describe: the kind ``can-dbc``."""
