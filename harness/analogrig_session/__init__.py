"""One page over all runs below a folder, with the trend of their delay over builds: ``analogrig report``."""
