"""Replaced by `realab_suite.launchers.serve`."""

if __name__ == '__main__':
  raise SystemExit(
      'error: realab_suite.experiments.serve has moved; run: python -m'
      ' realab_suite.launchers.serve'
  )
