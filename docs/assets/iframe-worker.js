/* Search in a browser that shows the site from files (file://): browsers start no Worker from a file.
 * This Worker runs its script in a hidden frame of the page instead. The theme's search script looks for
 * `IFrameWorker` in the parent window to find the folder of its own scripts.
 */
(function () {
  "use strict"
  if (location.protocol !== "file:") return

  function load(view, url) {
    return new Promise((resolve, reject) => {
      const script = view.document.createElement("script")
      script.src = url
      script.onload = resolve
      script.onerror = () => reject(new Error(`${url} cannot be loaded`))
      view.document.body.appendChild(script)
    })
  }

  class IFrameWorker extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      this.onerror = null
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.appendChild(this.frame)
      const view = this.frame.contentWindow
      view.postMessage = (data) => this.deliver(data)
      view.importScripts = (...urls) =>
        urls.reduce((done, next) => done.then(() => load(view, next)), Promise.resolve())
      this.ready = load(view, new URL(url, document.baseURI).href)
      this.ready.catch((error) => this.onerror && this.onerror(error))
    }

    deliver(data) {
      const event = new MessageEvent("message", { data })
      this.dispatchEvent(event)
      if (this.onmessage) this.onmessage(event)
    }

    postMessage(data) {
      this.ready.then(() => {
        const view = this.frame.contentWindow
        view.dispatchEvent(new view.MessageEvent("message", { data }))
      })
    }

    terminate() {
      this.frame.remove()
    }
  }

  window.IFrameWorker = IFrameWorker
  window.Worker = IFrameWorker
})()
