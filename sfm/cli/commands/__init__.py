"""The commands of the command line, a module for those of one purpose."""
