"""Campaigns: many trials of a device over plants, changes and noise. Plan, workers, results file and page."""
