"""The phase of every pulse, found from the range-compressed data alone: the autofocus family."""
