"""Traces for learning, which the stand-in has not."""

from nxsdk.faults import BoardError


class TraceCfgGen:
    def genTraceCfg(self, **kwargs):
        raise BoardError("the stand-in does not learn")
