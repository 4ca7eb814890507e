"""The analogue computer LUCIDAC: what is patched on it, its circuit, and its runs."""
