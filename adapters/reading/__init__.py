"""Reading of untrusted text and XML: line by line, within limits, with the location of every error."""
