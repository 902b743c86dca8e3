"""PI C-887 hexapod controllers, spoken to in GCS 2.0."""
