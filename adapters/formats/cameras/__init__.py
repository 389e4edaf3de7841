"""Files of calibrated cameras of other programs, a module a format; `registry` reads and writes all of them."""
