"""A headless Chromium for tests; they are skipped where there is none."""

import contextlib
import os
import shutil

import pytest

from tests import patience

# Software rendering, and no connections of the browser's own.
_ARGUMENTS = (
    '--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader',
    '--enable-unsafe-swiftshader', '--disable-quic', '--no-first-run',
    '--disable-background-networking', '--disable-component-update',
    '--disable-sync',
)  # fmt: skip


def needed():
  """Skips the test where Chromium or the extra `browser` is missing."""
  for module in ('websockets', 'PIL', 'playwright'):
    pytest.importorskip(module)
  if _executable() is None:
    pytest.skip('there is no Chromium; install it, or set CHROMIUM to its path')


@contextlib.contextmanager
def page(width=1040, height=720, offline=False, has_touch=False):
  """Yields a page, and a list of the addresses that it has requested.

  Args:
    width: Width of the window, in pixels.
    height: Height of the window, in pixels.
    offline: True for a browser without a network.
    has_touch: True for a screen that is touched, such as that of a phone.
  """
  from playwright import sync_api

  with sync_api.sync_playwright() as playwright:
    browser = playwright.chromium.launch(
        executable_path=_executable(), args=list(_ARGUMENTS)
    )
    try:
      one = browser.new_page(
          viewport={'width': width, 'height': height},
          offline=offline,
          has_touch=has_touch,
          is_mobile=has_touch,
      )
      one.set_default_timeout(1000 * patience.SECONDS)
      problems, requests = [], []
      one.on('pageerror', lambda problem: problems.append(problem))
      one.on('request', lambda request: requests.append(request.url))
      yield one, requests
      assert not problems
    finally:
      browser.close()


def _executable():
  return os.environ.get('CHROMIUM') or next(
      filter(None, map(shutil.which, ('chromium', 'chromium-browser'))), None
  )
