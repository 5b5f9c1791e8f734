"""The message of the `SpecError` that a call raises."""

from collections.abc import Callable
from typing import Any

import pytest

from realab_suite import errors


def refusal(function: Callable[..., Any], *args: Any, **kwargs: Any) -> str:
  """Returns the message of the error, which must be one printable line."""
  with pytest.raises(errors.SpecError) as caught:
    function(*args, **kwargs)
  text = str(caught.value)
  assert text.isprintable()
  return text
