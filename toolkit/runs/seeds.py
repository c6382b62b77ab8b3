"""Which seeds are for what: the first of a million of each purpose's own, so that no episode is measured that was trained on."""

TRAINING_SEEDS = 10**6
"""Training episodes of a transfer take their seeds below this number."""
CHECKING_SEEDS = 2 * 10**6
"""The schedule measures success on seeds from here on, and a second time after the same update on those of the million before: the same
for every robot (common random numbers), none trained."""
DEMONSTRATION_SEEDS = 3 * 10**6
"""The expert's demonstrations, and the choice among those who demonstrate."""
EXPERT_SEEDS = 4 * 10**6
"""The expert's training by NPG."""
VISIT_SEEDS = 5 * 10**6
"""Episodes of the clone that its teacher corrects."""
SHOWING_SEEDS = 6 * 10**6
"""What the expert shows a transfer on the source."""
SENSITIVITY_SEEDS = 7 * 10**6
"""Short rollouts that weigh the evolution parameters, and the episodes that judge a metric."""
SCRIPT_SEEDS = 8 * 10**6
"""Episodes of the script on the robots of an audit."""
EVALUATION_SEEDS = 10**9
"""Evaluations, in simulation and on an arm; training and the schedule's own checks stay far below."""
