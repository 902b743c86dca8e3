"""What is identified of a link, from the log of a step: feedforward, photodiodes and delay."""
