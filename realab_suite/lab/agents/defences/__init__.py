"""Defences of learners against corrupted rewards; see `base`."""

from realab_suite.lab.agents.defences.alarm import Alarm
from realab_suite.lab.agents.defences.base import DEFENCES
from realab_suite.lab.agents.defences.base import Batch
from realab_suite.lab.agents.defences.base import Defence
from realab_suite.lab.agents.defences.base import Setting
from realab_suite.lab.agents.defences.base import Treated
from realab_suite.lab.agents.defences.base import blinded
from realab_suite.lab.agents.defences.base import data_of
from realab_suite.lab.agents.defences.cap import Cap
from realab_suite.lab.agents.defences.learned_reward import LearnedReward
from realab_suite.lab.agents.defences.mona import Mona
from realab_suite.lab.agents.defences.orpo import Orpo
