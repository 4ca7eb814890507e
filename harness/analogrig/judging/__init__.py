"""Verdicts: judge a run against its scenario, with the information bound and exposure."""
