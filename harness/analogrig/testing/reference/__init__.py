"""Reference of the estimator that a device describes: the equations of background/estimator.md in float64.

It is no port of the C. Whatever the device reports is compared with it (``comparison``). The trigger is one class
(``trigger``), so that another one takes its place without a change of the rest.
"""
