"""Looking at results: every picture, widget and page. workbench computes, this draws."""
