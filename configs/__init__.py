"""Data only: the YAML files shipped as `realab_suite.configs`."""
