"""Number of examples of property tests, in the profiles `ci` and `long`."""

import hypothesis

_USUAL = 100
# Whether tests may take minutes.
IS_LONG = hypothesis.settings.default.max_examples > _USUAL


def settings(number: int) -> hypothesis.settings:
  """Returns settings of a test whose examples take longer than most.

  Args:
    number: Number of examples in the profile `ci`. The profile `long` has as
      many times more as it has by default.
  """
  factor = hypothesis.settings.default.max_examples / _USUAL
  return hypothesis.settings(max_examples=max(1, round(number * factor)))
