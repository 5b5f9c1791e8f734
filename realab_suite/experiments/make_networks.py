"""Replaced by `realab_suite.launchers.make_networks`."""

if __name__ == '__main__':
  raise SystemExit(
      'error: realab_suite.experiments.make_networks has moved; run: python -m'
      ' realab_suite.launchers.make_networks'
  )
