"""From a cabinet of hardware to a star held: the steps of `fitctl commission`, and their record."""
