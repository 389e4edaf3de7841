"""Reading of untrusted text, XML, YAML and JSON: within limits, with the location of every error."""
