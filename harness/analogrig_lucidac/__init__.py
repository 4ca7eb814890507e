"""LUCIDAC as an instrument, and a served one that is emulated."""
