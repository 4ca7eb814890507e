"""Many trials of a device over plants, changes and noise: what is played, who works, the file of results, its page."""
