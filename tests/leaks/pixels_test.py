"""Tests for what cameras show of meters; pictures need a renderer."""

import pytest

from campaigns import pixels_campaign


@pytest.mark.camera
@pytest.mark.parametrize('hiding', pixels_campaign.HIDING)
def test_a_camera_shows_a_meter_unless_it_is_hidden(hiding: str):
  seen = list(pixels_campaign.look('collect_apples', 0, hiding, values=2))
  assert [s.mode for s in seen] == [*pixels_campaign.MODES, 'agent']
  for one in seen:
    assert (one.num_pixels > 0) == (hiding == 'visible'), one
