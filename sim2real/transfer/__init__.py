"""Networks trained in simulation on real frames: experiments, correction by some frames, gaps."""
