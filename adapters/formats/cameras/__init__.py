"""Files of calibrated cameras, a module a format; `registry` reads and writes all of them."""
