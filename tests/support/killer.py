"""A listener that ends a stage half way, as a kill would."""


class Killer:
    """Ends the process, as seen from inside, when a stage is half done."""

    def started(self, stage):
        pass

    def advanced(self, _stage, done, total, _note):
        if done >= 0.5 * total:
            raise KeyboardInterrupt

    def waiting(self, stage, process_id):
        pass

    def finished(self, stage, seconds, *, is_new):
        pass
