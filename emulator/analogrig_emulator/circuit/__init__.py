"""Netlists: elements, real components, nodal analysis, and the deck for ngspice."""
