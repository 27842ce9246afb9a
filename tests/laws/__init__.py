"""Laws of algebra that stages and estimators keep for any data."""
