"""Replaced by `realab_suite.launchers.sweep`."""

if __name__ == '__main__':
  raise SystemExit(
      'error: realab_suite.experiments.sweep has moved; run: python -m'
      ' realab_suite.launchers.sweep'
  )
