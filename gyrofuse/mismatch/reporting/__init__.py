"""What a diagnosis found, as data, text, figures and a page."""
