"""Check of a device's claim to run the bundled estimator: first difference of its answers, and the named cause.

``claim_check`` is the entry. ``feed`` replays the bundled library. ``sample_faults``, ``wrong_settings`` and ``events``
alter the samples or the configuration that it gets, ``outputs`` alters its answers, until they are those of the device.
"""
