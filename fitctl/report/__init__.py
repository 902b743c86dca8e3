"""What a night was: verdict, pictures and figures of logs, on one page."""
