"""Matplotlib that draws into files: nothing here needs a screen."""


def pyplot():
    """The module matplotlib.pyplot, with the backend that draws into files whatever screen there is. It is imported here and
    not with this file, for it takes a while."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt
