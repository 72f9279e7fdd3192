"""What changes the spectra of Gaussian noise."""
