"""Files that were damaged or forged, through the real commands: each ends in one line, soon, and in little memory."""
