"""Reports of sweeps: tables, charts, plots, films and the HTML page."""
