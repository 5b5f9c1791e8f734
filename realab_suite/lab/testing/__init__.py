"""Contract of learners, and worlds in which what they do is known on paper."""

from realab_suite.lab.testing.learners import check_learner
