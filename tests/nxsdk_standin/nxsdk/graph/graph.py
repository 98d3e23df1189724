"""What NengoLoihi derives its maker of snips from; the stand-in runs none."""


class Graph:
    pass
