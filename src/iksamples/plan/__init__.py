"""What a study will take, before it is started."""

from iksamples.plan.budget import require_affordable, resources
from iksamples.plan.steps import is_apart, plan_study, proof_seconds, seeds_per_job
