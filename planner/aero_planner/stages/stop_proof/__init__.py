"""Stop proof: a candidate is flown only while a backup stop remains that is clear and in seen space."""
