{{- define "unbend.name" -}}
{{- .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- end -}}

{{- define "unbend.labels" -}}
app.kubernetes.io/name: unbend
app.kubernetes.io/instance: {{ .Release.Name }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
{{- end -}}

{{- define "unbend.selector" -}}
app.kubernetes.io/name: unbend
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end -}}

{{/* The components that are enabled, each over the defaults, by name, as JSON. */}}
{{- define "unbend.components" -}}
{{- $found := dict -}}
{{- range $name, $own := .Values.components -}}
{{- $component := mustMergeOverwrite (deepCopy $.Values.defaults) $own -}}
{{- if $component.enabled -}}
{{- $suffix := eq $name "all" | ternary "" (printf "-%s" $name) -}}
{{- $_ := set $component "fullname" (printf "%s%s" (include "unbend.name" $) $suffix) -}}
{{- $_ := set $component "front" (ne $component.role "estimate") -}}
{{- $_ := set $found $name $component -}}
{{- end -}}
{{- end -}}
{{- toJson $found -}}
{{- end -}}

{{/* Environment of one component, as a map: what the chart derives, then what the values say. The pause before SIGTERM is
     the notice that load balancers get, so the service need not give another. There is no limit of cores to count them by, so
     the pod would start a process for each of the node; and what pictures may take has to fit into the limit of memory. */}}
{{- define "unbend.environment" -}}
{{- $root := .root -}}
{{- $c := .component -}}
{{- $cpu := toString $c.cpu -}}
{{- $asked := hasSuffix "m" $cpu | ternary (divf (trimSuffix "m" $cpu) 1000) (float64 $cpu) -}}
{{- $cores := int64 (ceil $asked) -}}
{{- $processes := mul $c.memory.processesMiB 1048576 -}}
{{- $env := dict
  "UNBEND_WORKERS" (gt (int $c.gpus) 0 | ternary (min $cores 4) $cores | toString)
  "UNBEND_DECODERS" (toString $cores)
  "UNBEND_ESTIMATOR_THREADS" (toString $cores)
  "UNBEND_PICTURES_BYTES" (div $processes 4 | toString)
  "UNBEND_BODIES_BYTES" (div $processes 16 | toString)
  "UNBEND_STREAM_FRAMES_BYTES" (div $processes 16 | toString)
  "UNBEND_DECODE_MEMORY_BYTES" (div (mul $processes 3) (mul $cores 8) | toString)
  "UNBEND_ROLE" $c.role
  "UNBEND_DRAIN_NOTICE_S" "0"
  "UNBEND_DRAIN_S" (toString $root.Values.drainSeconds)
  "UNBEND_SHARED_MEMORY_BYTES" (mul $c.memory.framesMiB 1048576 | toString)
-}}
{{- if gt (int $c.gpus) 0 }}{{ $_ := set $env "UNBEND_REQUIRE_GPU" "true" }}{{ end -}}
{{- if eq $c.role "render" }}{{ $_ := set $env "UNBEND_ESTIMATOR_ADDRESS" (printf "dns:///%s-estimate:50051" (include "unbend.name" $root)) }}{{ end -}}
{{- if $root.Values.redis.url }}{{ $_ := set $env "UNBEND_GRID_STORE" "redis" }}{{ $_ := set $env "UNBEND_REDIS_URL" $root.Values.redis.url }}{{ end -}}
{{- if and $c.front $root.Values.access.tokensSecret }}{{ $_ := set $env "UNBEND_TOKENS_FILE" "/etc/unbend/access/tokens" }}{{ else }}{{ $_ := set $env "UNBEND_OPEN_ACCESS" "true" }}{{ end -}}
{{- if and $c.front $root.Values.tls.existingSecret -}}
{{- $_ := set $env "UNBEND_TLS_CERT" "/etc/unbend/tls/tls.crt" -}}
{{- $_ := set $env "UNBEND_TLS_KEY" "/etc/unbend/tls/tls.key" -}}
{{- if $root.Values.tls.clientCa }}{{ $_ := set $env "UNBEND_TLS_CLIENT_CA" "/etc/unbend/tls/ca.crt" }}{{ end -}}
{{- end -}}
{{- toJson (mustMergeOverwrite $env $root.Values.env $c.env) -}}
{{- end -}}

{{/* The kubelet speaks gRPC in plain text only; with TLS it asks the listener for health instead. */}}
{{- define "unbend.probe" -}}
{{- if .tls -}}
httpGet: {path: {{ .path }}, port: ops, scheme: HTTPS}
{{- else -}}
grpc: {port: 50051, service: {{ .service | quote }}}
{{- end -}}
{{- end -}}
