"""Replaced by `realab_suite.launchers.explore`."""

if __name__ == '__main__':
  raise SystemExit(
      'error: realab_suite.explore has moved; run: python -m'
      ' realab_suite.launchers.explore'
  )
