// Between a page in a notebook's output and Python: rows of samples go one way. No view of it is shown.

export default {
  initialize({ model }) {
    const key = model.get('key');
    const attach = page => page && page.postMessage({ loopwright: key, attach: true }, '*');
    const listen = ({ data, source }) => {
      if (!data || data.loopwright !== key) return;
      const { rows, ...about } = data;
      if (data.ready) attach(source); else if (rows) model.send(about, undefined, [rows]);
    };
    window.addEventListener('message', listen);
    for (const frame of document.querySelectorAll('iframe')) attach(frame.contentWindow);  // those that were there before
    return () => window.removeEventListener('message', listen);
  },
};
