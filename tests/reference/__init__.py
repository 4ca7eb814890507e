"""Reference of the estimator: the equations of harness/docs/background/estimator.md in plain Python and float64.

It follows the documents, not the C. ``tests/estimator_c`` compares the C with it. The trigger is one class
(``trigger``), so that another one takes its place without a change of the rest.
"""
