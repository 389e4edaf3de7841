"""Reading text, JSON and XML as untrusted: line by line, bounded, whatever is wrong named with its place."""
