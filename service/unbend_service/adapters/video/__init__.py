"""Video files, streams and pipes: PyAV (extra ``[video]``) and y4m."""
