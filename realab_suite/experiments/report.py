"""Replaced by `realab_suite.launchers.report`."""

if __name__ == '__main__':
  raise SystemExit(
      'error: realab_suite.experiments.report has moved; run: python -m'
      ' realab_suite.launchers.report'
  )
