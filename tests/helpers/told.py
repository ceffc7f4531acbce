"""What people are told of the facts of a screening or of the stages."""

from uwblite.assessment.facts import say


def told(facts):
    """Return the finding of each fact."""
    return list(say(facts))


def warned(stages):
    """Return the warnings that the rules make of the facts of stages."""
    return [finding for finding in told(stages.facts) if finding.severity == "warning"]


def doubted(stages):
    """Return the doubts that the rules make of the facts of stages."""
    return [finding for finding in told(stages.facts) if finding.severity == "doubt"]
