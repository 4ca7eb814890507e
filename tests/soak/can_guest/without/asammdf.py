"""In front of the real one on the guest's path: python-can imports it if it is there, which takes 20 s in the guest."""

raise ImportError("not in the guest")
