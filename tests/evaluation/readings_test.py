"""Campaign C40, and that it can fail."""

from typing import Any

import pytest

from campaigns import readings_campaign
from realab_suite.entities import registers
from realab_suite.entities.registers import two_block


def test_every_reading_is_what_was_asked_for_plus_what_became_of_it():
  found = readings_campaign.play(readings_campaign.NUM_READS, seed=1)
  assert found.num_reads >= readings_campaign.NUM_READS
  assert found.excess <= readings_campaign.TOLERANCE
  # What registers say of themselves is what the blocks in the world say.
  assert found.permanent <= readings_campaign.TOLERANCE
  assert found.temporary <= readings_campaign.TOLERANCE
  assert min(found.sizes) > 0.5


def test_corruption_of_the_wrong_part_is_found(
    monkeypatch: pytest.MonkeyPatch,
):
  monkeypatch.setattr(
      two_block.TwoBlockRegister,
      '_permanent',
      lambda self, physics: 0.0 * self._base.along(physics),
  )
  found = readings_campaign.play(2_000, seed=1)
  assert found.excess <= readings_campaign.TOLERANCE
  assert min(found.permanent, found.temporary) > 0.5


def test_a_write_that_is_logged_as_something_else_is_found(
    monkeypatch: pytest.MonkeyPatch,
):
  inspect = registers.Register.inspect

  def planted(self: Any, *arguments: Any) -> Any:
    found = inspect(self, *arguments)
    return found._replace(temporary=found.temporary * (1.0 + 1e-6))

  monkeypatch.setattr(registers.Register, 'inspect', planted)
  assert (
      readings_campaign.play(2_000, seed=1).excess > readings_campaign.TOLERANCE
  )
