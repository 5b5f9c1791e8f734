"""Data only: the YAML files that ship as `realab_suite.configs`."""
