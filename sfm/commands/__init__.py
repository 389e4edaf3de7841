"""The commands of Kolinear besides run, adjust and batch, by what they are about."""
