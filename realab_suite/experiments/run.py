"""Replaced by `realab_suite.launchers.compare` and `launchers.train`."""

if __name__ == '__main__':
  raise SystemExit(
      'error: realab_suite.experiments.run was split; run: python -m'
      ' realab_suite.launchers.compare, or python -m'
      ' realab_suite.launchers.train with --experiment'
  )
