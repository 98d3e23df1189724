"""Learning rules, which the stand-in has not."""

from nxsdk.faults import BoardError


def ruleToUCode(rules, doOptimize):
    raise BoardError("the stand-in does not learn")
