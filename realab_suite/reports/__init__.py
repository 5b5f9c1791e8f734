"""Reports of sweeps: tables, plots, films and the HTML page."""
