"""Making designs: from what is known of a loop to the matrices of a vernier/coarse pair."""
