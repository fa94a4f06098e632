"""Results as tables, figures and one HTML file."""
